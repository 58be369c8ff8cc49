"""T by least squares, against quadrature and a linear system."""

import numpy as np
import pytest
import torch
from linear_system import Oscillator, sylvester
from quadrature import backward_quadrature
from small_runs import CPU

from kkl_gym import ReverseDuffing
from kkl_gym.simulate import simulate
from training.maps.least_squares import solve_forward
from training.maps.networks import on_torch
from training.spectrum import Spectrum


def test_solved_forward_map_of_reverse_duffing_against_backward_quadrature():
    """One map, in X and beyond."""
    system, linear = ReverseDuffing(), Spectrum((-1.5, -1.875, -2.25, -2.625, -3.0)).filter(1, 0.01)
    rng = np.random.default_rng(0)
    x0 = np.concatenate([rng.uniform(*system.box(), (40, 2)), rng.uniform(*system.box(2.0), (60, 2))])
    points = simulate(system, x0, 400, 0.05)[::3].reshape(-1, 2)
    T = solve_forward(system, linear, features=400, points=points, rng=rng)
    rng = np.random.default_rng(1)
    inside = rng.uniform(*system.box(), (12, 2))
    beyond = rng.uniform(*system.box(2), (24, 2))
    beyond = beyond[(np.abs(beyond) > 2).any(1)]
    for x in (inside, beyond):
        truth = np.array([backward_quadrature(point, linear.A.diagonal()) for point in x])
        assert np.sqrt(np.square(T(x) - truth).sum() / np.square(truth).sum()) < 2e-3
    on_tensors_too = on_torch(T, CPU)(torch.as_tensor(inside, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(on_tensors_too, T(inside), atol=1e-4)


@pytest.mark.parametrize(
    ("spectrum", "unit"), [(Spectrum((-1.0, -2.0, -3.0)), 1.0), (Spectrum((-1.0,), ((-0.5, 2.0),)), 1e-14)]
)
def test_solved_forward_map_of_a_linear_system(spectrum, unit):
    linear, rng = spectrum.filter(1, 0.01), np.random.default_rng(0)
    T = solve_forward(Oscillator(), linear, features=100, points=unit * rng.uniform(-1, 1, (2000, 2)), rng=rng)
    x = unit * np.random.default_rng(1).uniform(-1, 1, (50, 2))
    expected = x @ sylvester(linear.A, linear.B).T
    assert np.abs(T(x) - expected).max() < 1e-2 * np.abs(expected).max()
    np.testing.assert_allclose(T.z_scale, expected.std(0), rtol=0.3)
