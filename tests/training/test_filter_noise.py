"""What the filter passes on of the noise on y, against simulation and closed forms."""

import numpy as np

from observers import LinearFilter
from training.filter_noise import noise_covariance, root, stationary_covariance


def test_noise_covariance_against_simulation_at_every_age():
    B = np.array([[1.0, 0.0], [1.0, 2.0], [0.0, 1.0]])
    linear = LinearFilter(np.diag([-0.5, -4.0, -20.0]), B, 0.05)
    ages = np.array([0, 1, 2, 5, 50])
    n, levels = 50_000, np.array([1.0, 0.3])
    y = np.random.default_rng(0).normal(size=(51, n, 2)) * levels
    e = linear.run(y, np.zeros((50, n, 0)), ages)
    together = np.einsum("j,ajkl->akl", levels**2, noise_covariance(linear, ages))
    for predicted, sample in zip(together, e, strict=True):
        measured = sample.T @ sample / n
        size = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
        assert np.abs(measured - predicted).max() / size.max() < 0.03


def test_noise_covariance_tends_to_the_lyapunov_solution():
    linear = LinearFilter(np.diag([-0.5, -4.0]), np.ones((2, 1)), 0.01, 1)
    late = noise_covariance(linear, np.array([5000]))[0, 0]
    np.testing.assert_allclose(late, stationary_covariance(linear)[0], rtol=1e-9, atol=1e-15)
    assert not late[2:].any()  # the input is known exactly
    np.testing.assert_allclose(root(late) @ root(late).T, late, atol=1e-15)
