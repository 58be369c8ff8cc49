"""The configurations behind --preset."""

from dataclasses import replace

import pytest
from linear_system import Oscillator, TwoOutputs, TwoUnits

from kkl_gym import Lorenz, Rossler, VanDerPol
from training import preset, presets
from training.config import Config
from training.presets import PROFILES


def test_paper_preset_has_the_papers_table():
    config = preset(VanDerPol(), "spinn", "paper")
    assert (config.width, config.depth, config.activation, config.learning_rate) == (512, 4, "silu", 1e-3)
    assert config.physics_weight == 0.1
    assert len(config.eigenvalues) == 5
    assert (max(config.eigenvalues), min(config.eigenvalues)) == (-1.5, -3.0)
    assert isinstance(config, Config)
    assert all(value < 0 for value in presets.eigenvalues(Oscillator(), 0.01))


def test_spinn_of_a_user_system_has_fast_modes_and_keeps_a_given_spectrum(monkeypatch):
    for duration in (50.0, 200.0):
        config = preset(Oscillator(), "spinn", "fast", changes={"duration": duration, "width": None})
        assert -max(config.eigenvalues) * duration >= 30
        assert config.duration == duration
    monkeypatch.delattr(presets, "smooth_spectrum")
    given = {"eigenvalues": (-1.0, -2.0), "dt": 0.1, "seed": 3}
    config = preset(Oscillator(), "spinn", "fast", changes=given)
    assert {name: getattr(config, name) for name in given} == given
    assert config.box_factor == 2.0


def test_maps_are_trained_up_to_twice_the_usual_level_of_each_output():
    for system, levels in (
        (VanDerPol(), 1.0),
        (TwoOutputs(), (0.2, 0.6)),
        (Oscillator(), 0.2),
        (TwoUnits(), (200.0, 0.24)),
    ):
        for pipeline in ("input-aware", "spinn"):
            given = {"eigenvalues": (-1.0, -2.0)}
            assert preset(system, pipeline, "fast", changes=given).measurement_noise_max == levels
    assert preset(Lorenz(), "input-aware", "fast").measurement_noise_max == 3.0

    class Exact(TwoOutputs):
        """One sensor has no noise; maps are trained for noise all the same."""

        name = "exact"
        measurement_noise = (0.0, 0.3)

    assert preset(Exact(), "input-aware", "fast").measurement_noise_max == pytest.approx((0.2, 0.6), rel=0.01)


@pytest.mark.parametrize("name", ["fast", "paper"])
def test_uncertain_parameters_add_settings_of_the_systems_profile(name):
    def of(**changes):
        return preset(Rossler(), "input-aware", name, changes=changes)

    plain = of()
    assert plain.pairs == ()
    assert of(uncertain={"all": 0.0}) == replace(plain, uncertain={"all": 0.0})
    uncertain = {"c": 0.1}
    found = of(uncertain=uncertain)
    assert found.eigenvalues == plain.eigenvalues
    assert found.pairs == PROFILES["rossler"].uncertain_settings["pairs"]
    assert found.width == (512 if name == "paper" else 192)
    sizes = {} if name == "paper" else presets.LARGE
    assert preset(VanDerPol(), "input-aware", name, changes={"uncertain": {"mu": 0.1}}) == replace(
        preset(VanDerPol(), "input-aware", name), **sizes, uncertain={"mu": 0.1}
    )


def test_large_is_for_a_t_inv_without_a_tracker():
    small, large = (preset(VanDerPol(), size=size) for size in ("default", "large"))
    assert (small.width, large.width) == (20, 128)
    assert (small.pairs, len(large.pairs)) == ((), 4)
    assert preset(VanDerPol(), size="large", changes={"width": 8}).width == 8
    for wrong in ({"size": "huge"}, {"name": "slow"}, {"pipeline": "magic"}):
        with pytest.raises(ValueError, match=f"there is no {'preset' if 'name' in wrong else next(iter(wrong))} '"):
            preset(VanDerPol(), **wrong)
