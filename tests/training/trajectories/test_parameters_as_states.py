"""Systems with parameters as additional states."""

from dataclasses import dataclass

import numpy as np
import pytest
from discrete_systems import Henon
from linear_system import Oscillator

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from kkl_gym.systems import Lorenz
from training.trajectories.parameters import NOMINAL_SHARE, relative_ranges, with_bias, with_parameters


@dataclass(frozen=True)
class Motor(System):
    """A system with parameters in the input matrix and in the output."""

    gain: float = 2.0
    offset: float = 0.5
    name, X, bounds, u_max = "motor", ((-1.0, 1.0),), ((-9.0, 9.0),), (1.0,)

    def f(self, x):
        return (-x[0],)

    def g(self, x):
        return ((self.gain,),)

    def h(self, x):
        return (x[0] + self.offset,)


def test_each_motion_is_that_of_its_own_parameters():
    system = Lorenz()
    both = with_parameters(system, {"rho": (20.0, 40.0), "beta": (2.0, 3.0)})
    start = both.draw_starts(np.random.default_rng(0), 3)
    x = simulate(both, start, 50, 0.01)
    for row, x0 in enumerate(start):
        own = system.replace({"rho": x0[3], "beta": x0[4]})
        np.testing.assert_allclose(x[:, row, :3], simulate(own, x0[None, :3], 50, 0.01)[:, 0], rtol=1e-6)
        np.testing.assert_array_equal(x[:, row, 3:], np.broadcast_to(x0[3:], (51, 2)))


def test_parameters_of_inputs_and_outputs():
    system = with_parameters(Motor(), {"gain": (1.0, 3.0), "offset": (0.0, 1.0)})
    x = simulate(system, np.array([[0.0, 3.0, 0.25]]), 1, 0.5, u=np.full((1, 1, 1), 0.7))
    assert x[1, 0, 0] == pytest.approx(3.0 * 0.7 * (1 - np.exp(-0.5)), rel=1e-6)
    assert system.output(x[1, 0])[0] == pytest.approx(x[1, 0, 0] + 0.25)


def test_ranges_about_the_values():
    lorenz = Lorenz(beta=-2.0)
    assert relative_ranges(lorenz, {"rho": 0.5}) == {"rho": (14.0, 42.0)}
    found = relative_ranges(lorenz, {"all": 0.1, "rho": 0.5, "sigma": 0.0})
    assert found == {"rho": (14.0, 42.0), "beta": (-2.2, -1.8)}
    assert relative_ranges(lorenz, {}) == {}
    assert with_parameters(lorenz, {}) is lorenz


def test_invalid_ranges_are_refused():
    for system, widths, message in (
        (Lorenz(), {"nu": 0.1}, "no parameter 'nu' to be uncertain; it has sigma, rho, beta"),
        (Lorenz(beta=0.0), {"all": 0.1}, "beta of lorenz is 0 and has no relative range: exclude it"),
        (Oscillator(), {"all": 0.1}, "oscillator has no parameters"),
    ):
        with pytest.raises(ValueError, match=message):
            relative_ranges(system, widths)


def test_in_discrete_time():
    x = simulate(with_parameters(Henon(), {"b": (0.2, 0.5)}), np.array([[0.5, 0.1, 0.4]]), 2, 1.0)
    np.testing.assert_allclose(x[:, 0, 1], [0.1, 0.4 * 0.5, 0.4 * (1.0 - 1.4 * 0.25 + 0.1)])


def test_trainings_have_the_nominal_parameters_or_some_towards_the_ends():
    system = Lorenz()
    ranges = relative_ranges(system, {"sigma": 0.1, "beta": 0.3})
    drawn = with_parameters(system, ranges, in_training=True).draw_starts(np.random.default_rng(0), 20_000)[:, 3:]
    own = [system.sigma, system.beta]
    nominal = (drawn == own).all(-1)
    assert nominal.mean() == pytest.approx(NOMINAL_SHARE**2, abs=0.02)
    assert (nominal == (drawn == own).any(-1)).all()  # both parameters are nominal, or neither
    share = (drawn[~nominal] / own - 1) / [0.1, 0.3]
    assert np.abs(share).max() <= 1 + 1e-12
    for part in (0.5, 0.9):  # shares of the half-width: sines of uniform angles
        assert (np.abs(share) < part).mean(0) == pytest.approx(2 * np.arcsin(part) / np.pi, abs=0.02)
    assert np.corrcoef(share.T)[0, 1] == pytest.approx(0, abs=0.03)


def test_a_bias_of_an_output_is_a_constant_state():
    system = with_bias(Motor(gain=3.0, offset=0.25), 0.5)
    assert (system.nx, system.state_names[1:], system.X[1]) == (2, ("y1_bias",), (-0.5, 0.5))
    x0 = np.array([[0.4, -0.3]])
    x = simulate(system, x0, 50, 0.1, u=np.full((50, 1, 1), 0.2))
    np.testing.assert_array_equal(x[..., 1], -0.3)
    np.testing.assert_allclose(system.output(x)[..., 0], x[..., 0] + 0.25 - 0.3)
    alone = simulate(Motor(gain=3.0), x0[:, :1], 50, 0.1, u=np.full((50, 1, 1), 0.2))
    np.testing.assert_allclose(x[..., :1], alone, rtol=1e-12)
