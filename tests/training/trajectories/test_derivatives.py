"""What differentiating a system's equations gives."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from linear_system import Oscillator

from kkl_gym import get_system
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


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol", "rossler", "lorenz"])
def test_sensitivity_is_the_derivative_of_the_flow(name):
    system, dt, eps = get_system(name), 0.05, 1e-5
    nx = system.nx
    x = np.random.default_rng(0).uniform(*system.box(0.5), (4, nx))
    start = np.concatenate([x, np.tile(np.eye(nx).ravel(), (4, 1))], 1)
    Phi = simulate(with_sensitivity(system), start, 1, dt)[1][:, nx:].reshape(4, nx, nx)
    for j in range(nx):
        step = eps * np.eye(nx)[j]
        difference = (simulate(system, x + step, 1, dt)[1] - simulate(system, x - step, 1, dt)[1]) / (2 * eps)
        np.testing.assert_allclose(Phi[..., j], difference, rtol=1e-5, atol=1e-6)


def test_equations_that_take_no_symbols_are_named():
    with pytest.raises(ValueError, match=r"take symbols, from kkl_gym\.elementary"):
        jacobian(lambda x: (np.sin(x[0]),), 2)
