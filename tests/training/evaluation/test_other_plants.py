"""Plants that are not the model, from Python."""

from dataclasses import dataclass

import numpy as np
import pytest
from linear_system import TwoOutputs

import kkl_gym.elementary as e
from kkl_gym import System, VanDerPol, get_system
from training import unseen_trajectories
from training.evaluation.errors import measured
from training.evaluation.plants import off_by, show_parameters


@dataclass(frozen=True)
class Turning(System):
    """Turns by omega dt in a sample, what is measured is in other units."""

    omega: float = 1.0
    gain: float = 1.0

    name = "turning"
    X, bounds = ((-1, 1), (-1, 1)), ((-9, 9), (-9, 9))
    u_max, dt = (0.5,), 0.05

    def step(self, x, u):
        c, s = e.cos(self.omega * self.dt), e.sin(self.omega * self.dt)
        return c * x[0] + s * x[1], c * x[1] - s * x[0] + self.dt * u[0]

    def h(self, x):
        return (self.gain * x[0],)


RUNS = {"dt": 0.05, "n": 6, "duration": 2.0, "seed": 3}


def test_every_parameter_is_off_by_a_share():
    assert off_by(get_system("lorenz"), 0.1).parameters == pytest.approx(
        {"sigma": 11.0, "rho": 30.8, "beta": 8.8 / 3}, rel=1e-12
    )
    assert off_by(get_system("reverse_duffing"), -0.1).parameters == {"a": 0.9, "b": 0.9}
    assert off_by(VanDerPol(-2.0), 0.5) == VanDerPol(-3.0)
    assert show_parameters(off_by(get_system("rossler"), 0.1)) == "a=0.22 b=0.22 c=6.27"
    for wrong in (np.nan, np.inf, "0.1", None, True):
        with pytest.raises(ValueError, match="the error of the parameters must be a finite number"):
            off_by(VanDerPol(), wrong)
    with pytest.raises(ValueError, match="two-outputs has no parameters that could be off"):
        off_by(TwoOutputs(), 0.1)


def test_a_plant_moves_from_the_models_starts_under_its_inputs():
    model, plant = Turning(), Turning(omega=2.0, gain=3.0)
    for driven in (False, True):
        right, other = (unseen_trajectories(model, **RUNS, driven=driven, plant=moving) for moving in (None, plant))
        assert np.array_equal(other.x[0], right.x[0])
        assert np.array_equal(other.u, right.u)
        assert other.u.any() == driven
        assert not np.allclose(other.x[1], right.x[1])
        for k in range(len(other.u)):
            np.testing.assert_allclose(np.transpose(plant.step(other.x[k].T, other.u[k].T)), other.x[k + 1], atol=1e-12)
    assert right.plant is None
    assert other.first(2).plant is plant
    noise = [measured(model, runs, 0.1, 0) - moving.output(runs.x) for runs, moving in ((right, model), (other, plant))]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)


def test_the_policy_is_the_models():
    model, plant, seen = Turning(), Turning(omega=2.0), []

    def policy(x):
        seen.append(x)
        return -x[:, :1]

    right = unseen_trajectories(model, **RUNS, policy=policy)
    other = unseen_trajectories(model, **RUNS, policy=policy, plant=plant)
    np.testing.assert_allclose(other.u[0], right.u[0])
    np.testing.assert_allclose(other.u, 0.5 * np.clip(-other.x[:-1, :, :1], -1, 1))
    np.testing.assert_allclose(np.transpose(plant.step(other.x[5].T, other.u[5].T)), other.x[6], atol=1e-12)


def test_a_plant_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"a plant of \(3, 1, 1\) states, inputs and outputs does not fit van_der_pol"):
        unseen_trajectories(VanDerPol(), **RUNS, plant=get_system("lorenz"))
