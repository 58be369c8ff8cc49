"""Training for plants with uncertain parameters."""

import io
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from rich.console import Console
from small_runs import CPU, toy
from spring import Spring

from kkl_gym import VanDerPol
from training import SimulatedSource, errors, train, unseen_trajectories
from training.evaluation.errors import parameter_errors
from training.spectrum import Spectrum
from training.trajectories.parameters import with_parameters


@dataclass(frozen=True)
class Undamped(Spring):
    """A spring without damping; its frequency is the root of the stiffness."""

    damping: float = 0.0

    process_noise: ClassVar = 0.0
    measurement_noise: ClassVar = 0.02


@cache
def trained(**uncertain):
    """An observer of free motion, for one plant or for a range of plants."""
    system = Undamped()
    own = {"inputs": False, "trajectories": 200, "duration": 15.0, "inverse_steps": 1200, "width": 24}
    own |= {"uncertain": uncertain, "estimate_parameters": True} if uncertain else {}
    config = toy(system, eigenvalues=(-0.4, -0.8, -1.6, -3.2, -6.4), **own)
    return train(system, config, device=CPU).artifact


def test_an_observer_for_uncertain_plants_holds_on_another():
    system = Undamped()
    plant = system.replace({"stiffness": 4.8})
    late = {}
    for name, artifact in {"one": replace(trained(), motion=None), "many": trained(stiffness=0.3)}.items():
        assert artifact.nx == 2
        for what, moving in {"model": system, "plant": plant}.items():
            runs = unseen_trajectories(moving, 0.05, n=20, duration=15.0, seed=3)
            late[name, what] = np.median(errors(artifact, moving, runs, measurement_noise=0.02, seed=3).late)
    assert late["many", "plant"] < 0.6 * late["one", "plant"]
    assert late["many", "model"] < 2.5 * late["one", "model"]  # loose, at this toy size


def test_the_observer_estimates_the_plants_parameter():
    system, artifact = Undamped(), trained(stiffness=0.3)
    assert artifact.estimated_parameters == ("stiffness",)
    assert artifact.parameter_ranges == {"stiffness": (2.8, 5.2)}
    drawn = 30.0 / np.sqrt(3)  # error in % of a constant estimate at the centre of the range
    many = with_parameters(system, artifact.parameter_ranges)
    runs = unseen_trajectories(many, artifact.filter.dt, n=30, duration=15.0, seed=5)
    clean, noisy = (parameter_errors(artifact, many, runs, measurement_noise=level, seed=5)[0] for level in (0.0, 0.02))
    assert clean < noisy < 0.5 * drawn


def test_pairs_hold_only_the_signals_that_the_map_estimates():
    config = toy(VanDerPol(), uncertain={"mu": 0.1}, trajectories=60, duration=1.0)
    for estimated in (False, True):
        source = SimulatedSource(VanDerPol(), replace(config, estimate_parameters=estimated))
        linear = Spectrum(config.eigenvalues).filter(1, config.dt, 1)
        pairs = source.pairs(linear)
        assert source.plant.state_names == ("x1", "x2", "mu")
        assert pairs.x.shape[-1] == 2 + estimated
        assert source.sampling(linear)["parameters"] == estimated
    mu = pairs.x[..., 2]
    np.testing.assert_array_equal(pairs.nominal, mu[0] == 3)
    assert 0.4 < pairs.nominal.mean() < 0.9
    np.testing.assert_allclose(mu, np.broadcast_to(mu[0], mu.shape), rtol=1e-9)
    assert 2.7 <= mu.min() < 2.8 < 3.2 < mu.max() <= 3.3


def test_maps_for_uncertain_parameters_do_not_track_and_print_the_reason():
    console = Console(file=io.StringIO(), width=200)
    config = toy(Undamped(), uncertain={"stiffness": 0.3}, duration=1.0, inverse_steps=2, inputs=False)
    artifact = train(Undamped(), config, device=CPU, console=console).artifact
    assert "a tracker needs exact parameters, but these are uncertain: stiffness" in console.file.getvalue()
    assert artifact.motion is None
    assert artifact.inverse.error_covariance.nx == 2


def test_a_name_that_is_no_parameter_is_refused_before_any_work(tmp_path):
    with pytest.raises(ValueError, match="no parameter 'nu' to be uncertain; it has mu"):
        train(VanDerPol(), toy(VanDerPol(), uncertain={"nu": 0.1}), tmp_path / "run", device=CPU)
    assert not (tmp_path / "run").exists()
