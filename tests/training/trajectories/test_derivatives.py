"""What differentiating a system's equations gives."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from linear_system import Oscillator

from kkl_gym import SYSTEMS, get_system
from kkl_gym.elementary import sin
from kkl_gym.simulate import simulate
from training.trajectories.derivatives import jacobian, output_matrix, with_sensitivity


def test_output_matrix_of_linear_and_other_outputs():
    @dataclass(frozen=True)
    class Squared(Oscillator):
        name: ClassVar[str] = "squared"

        def h(self, x):
            return (x[0] * x[0],)

    np.testing.assert_array_equal(output_matrix(get_system("rossler")), [[0.0, 1.0, 0.0]])
    assert output_matrix(Squared()) is None


class Steered(Oscillator):
    """Two inputs through a matrix that depends on the state."""

    name: ClassVar[str] = "steered"
    u_max: ClassVar[tuple[float, ...]] = (1.0, 2.0)

    def g(self, x):
        return (x[1], 1.0), (x[0] * x[1], sin(x[0]))


@pytest.mark.parametrize("system", [*map(get_system, SYSTEMS), Steered()], ids=lambda system: system.name)
def test_sensitivity_is_the_derivative_of_the_flow(system):
    dt, eps, nx = 0.05, 1e-5, system.nx
    x = np.random.default_rng(0).uniform(*system.box(0.5), (4, nx))
    start = np.concatenate([x, np.tile(np.eye(nx).ravel(), (4, 1))], 1)
    u = np.random.default_rng(1).uniform(-1, 1, (1, 4, system.nu)) * system.u_max
    Phi = simulate(with_sensitivity(system), start, 1, dt, u=u)[1][:, nx:].reshape(4, nx, nx)
    for j in range(nx):
        step = eps * np.eye(nx)[j]
        difference = np.subtract(*(simulate(system, x + one, 1, dt, u=u)[1] for one in (step, -step))) / (2 * eps)
        np.testing.assert_allclose(Phi[..., j], difference, rtol=1e-5, atol=1e-6)


def test_equations_that_take_no_symbols_are_named():
    with pytest.raises(ValueError, match=r"x held sympy symbols: use kkl_gym\.elementary\.sin"):
        jacobian(lambda x: (np.sin(x[0]),), 2)
