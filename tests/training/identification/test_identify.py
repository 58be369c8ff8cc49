"""Parameters and observers from records of outputs."""

from typing import ClassVar

import numpy as np
import pytest
from spring import Spring

from kkl_gym.simulate import simulate
from kkl_gym.systems import Lorenz, ReverseDuffing, VanDerPol
from training.identification import estimate_parameters
from training.identification.identifiability import combinations, sign_symmetries, unidentifiable_directions, written
from training.identification.identify import nearest
from training.identification.windows import noise_level
from training.progress import progress_bars
from training.records import Record
from training.trajectories.motions import random_inputs


class HiddenSigns(Lorenz):
    """The Lorenz system with the output x3."""

    name: ClassVar[str] = "lorenz_x3"

    def h(self, x):
        return (x[2],)


def records(system, n, *, seconds, noise=0.0, seed=0, driven=False):
    """Records of outputs along motions from X."""
    rng, steps = np.random.default_rng(seed), round(seconds / system.dt)
    u = random_inputs(system, n, steps, dt=system.dt, rng=rng, kinds=("steps",)) if driven else None
    x = simulate(system, system.draw_starts(rng, n), steps, system.dt, u=u)
    y = system.output(x) + noise * rng.standard_normal((*x.shape[:2], system.ny))
    t = np.arange(steps + 1) * system.dt
    held = None if u is None else np.concatenate([u, u[-1:]])
    return [Record(f"run {i}", t, y[:, i], None if held is None else held[:, i]) for i in range(n)]


def found(system, unknown, measured, **options):
    limits = {name: (value / 10, value * 10) for name, value in unknown.items()}
    with progress_bars(None) as progress:
        return estimate_parameters(system.replace(unknown), limits, measured, progress=progress, **options)


UNKNOWN = {"stiffness": 6.0, "damping": 0.2, "gain": 1.4}


def test_without_noise_parameters_are_exact():
    got = found(Spring(), UNKNOWN, records(Spring(), 6, seconds=8, driven=True))
    assert got.system.parameters == pytest.approx(Spring().parameters, rel=1e-6)
    assert (got.symmetries, got.unscaled_states) == ([], ())
    prediction = got.predictions[0]
    np.testing.assert_allclose(prediction.y, prediction.record.y[: len(prediction.y)], atol=1e-6)
    assert list(got.to_json()) == ["stiffness", "damping", "gain"]


def test_noise_and_standard_errors():
    measured = records(Spring(), 6, seconds=8, noise=0.02, driven=True)
    got = found(Spring(), UNKNOWN, measured)
    for name, error in got.standard_errors.items():
        truth = Spring().parameters[name]
        assert abs(got.system.parameters[name] - truth) < 4 * error < 0.1 * truth, name
    assert got.noise == pytest.approx(0.02, rel=0.1)


def test_equal_seeds_find_equal_parameters():
    measured = records(Spring(), 2, seconds=5, noise=0.02)
    one, same = (found(Spring(), {"stiffness": 4.4}, measured, seed=1) for _ in range(2))
    assert one.system == same.system


def test_only_a_product_of_duffings_parameters_is_identifiable():
    class Duffing(ReverseDuffing):
        name: ClassVar[str] = "coarse_duffing"
        dt: ClassVar = 0.05

    got = found(Duffing(), {"a": 1.4, "b": 1.3}, records(Duffing(), 4, seconds=4))
    assert got.to_json() == {name: {"value": None, "standard_error": None} for name in "ab"}
    (product,) = got.products
    assert product.text == "a b^3"
    assert product.value == pytest.approx(1.0, rel=1e-5)
    assert got.unscaled_states == ("x2",)
    assert "a b^3 = 1" in " ".join(got.summary())
    assert got.system.a * got.system.b**3 == pytest.approx(1.0, rel=1e-5)
    assert got.system.a / got.system.b == pytest.approx(1.4 / 1.3, rel=0.01)  # nearest to the given values


def test_signs_that_are_not_identifiable():
    assert sign_symmetries(HiddenSigns(), ["sigma", "rho", "beta"]) == [("x1", "x2")]
    assert sign_symmetries(Lorenz(), ["sigma", "rho", "beta"]) == []
    assert sign_symmetries(ReverseDuffing(), ["a", "b"]) == [("x2", "a", "b")]
    assert sign_symmetries(ReverseDuffing(), ["a", "b"], driven=True) == []  # the symmetry does not hold with an input
    assert sign_symmetries(Spring(), ["gain"]) == [("gain",)]
    assert sign_symmetries(Spring(), ["gain"], driven=True) == []


def test_products_of_powers():
    hidden = np.array([[3.0, -1.0, 0.0]]).T / 10**0.5
    texts = {written(powers) for powers in combinations(["a", "b", "c"], hidden)}
    assert texts == {"a b^3", "c"}
    assert unidentifiable_directions(np.diag([1e4, 1e-9])).shape == (2, 1)
    assert combinations(["a"], np.eye(1)) == []


def test_the_nearest_parameters_keep_their_ratios():
    hidden = np.array([[3.0, -1.0]]).T / 10**0.5
    # The plant is 10 % faster; any parameters with a b^3 = 1.1^4 fit.
    anywhere = np.array([1.1 * 2.0**3, 1.1 / 2.0])
    assert nearest(anywhere, np.ones(2), hidden) == pytest.approx([1.1, 1.1], rel=1e-2)


def test_the_noise_of_records():
    assert noise_level(records(VanDerPol(), 4, seconds=10, noise=0.2)) == pytest.approx(0.2, rel=0.1)


def test_invalid_arguments():
    (free,), (driven,) = records(Spring(), 1, seconds=3), records(Spring(), 1, seconds=3, driven=True)
    doubled = Record("doubled", free.t, np.hstack([free.y, free.y]))
    stiffness = {"stiffness": (1.0, 9.0)}
    for unknown, given, message in (
        ({}, [free], "name an unknown parameter"),
        ({"mass": (0.0, 1.0)}, [free], "no parameter 'mass'"),
        ({"stiffness": (5.0, 6.0)}, [free], "= 4 must lie between finite limits, got 5.0 and 6.0"),
        ({"stiffness": (0.0, float("inf"))}, [free], "between finite limits, got 0.0 and inf"),
        (stiffness, [], "no records are given"),
        (stiffness, [doubled], "the measured columns are y1, y2, but spring has 1"),
        (stiffness, [free, driven], "inputs are columns u1, but none in"),
    ):
        with progress_bars(None) as progress, pytest.raises(ValueError, match=message):
            estimate_parameters(Spring(), unknown, given, progress=progress)


def test_a_parameter_at_its_limit_is_reported():
    measured, limits = records(Spring(), 2, seconds=8, noise=0.05), {"stiffness": (3.0, 3.7)}
    with progress_bars(None) as progress:
        got = estimate_parameters(Spring(3.5), limits, measured, progress=progress)
    assert got.at_limits == ("stiffness",)
    assert "stiffness is at its limit: give it a wider range" in got.summary()
    assert "fewer than 20 windows" in " ".join(got.summary())
