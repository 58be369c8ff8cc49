"""Coordinates of the networks' inputs and outputs, and the covariance of noise in the filter state."""

import numpy as np

from observers import LinearFilter
from training.maps.coordinates import (
    LEAST,
    StateScale,
    coordinates,
    noise_covariance,
    root,
    spread,
    stationary_covariance,
)
from training.trajectories.motions import filter_states


def test_coordinates_make_the_signal_white_and_the_noise_diagonal():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(5000, 3)) @ np.array([[1.0, 1.0, 1.0], [0.0, 1e-3, 2e-3], [0, 0, 1e-5]]) + 7.0
    noise = np.diag([1e-3, 2e-3, 1e-3])
    found = coordinates(z, noise)
    np.testing.assert_allclose(np.cov(found(z).T, bias=True), np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found.whiten @ noise @ found.whiten.T, np.diag(found.noise_gain**2), atol=1e-3)
    assert (np.diff(found.noise_gain) >= 0).all()
    flat = coordinates(z[:, [0, 0, 0]], noise)
    assert len(flat.noise_gain) == 1  # two modes hold only rounding


def test_spread_has_the_units_of_z_and_ignores_rounding():
    z = np.random.default_rng(0).normal(size=(1000, 3)) * [1e-20, 1.0, 1e-15] + [0.0, 1e6, 1.0]
    np.testing.assert_allclose(spread(z), [1e-20, 1.0, 1.0], rtol=0.1)
    assert (spread(np.zeros((10, 2))) == 1.0).all()


def test_noise_covariance_against_simulation_at_every_age():
    B = np.array([[1.0, 0.0], [1.0, 2.0], [0.0, 1.0]])
    linear = LinearFilter(np.diag([-0.5, -4.0, -20.0]), B, 0.05)
    ages = np.array([0, 1, 2, 5, 50])
    n, levels = 50_000, np.array([1.0, 0.3])
    y = np.random.default_rng(0).normal(size=(51, n, 2)) * levels
    e = filter_states(linear, y, np.zeros((50, n, 0)), ages)
    together = np.einsum("j,ajkl->akl", levels**2, noise_covariance(linear, ages))
    for predicted, sample in zip(together, e, strict=True):
        measured = sample.T @ sample / n
        size = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
        assert np.abs(measured - predicted).max() / size.max() < 0.03


def test_noise_covariance_tends_to_the_lyapunov_solution():
    linear = LinearFilter(np.diag([-0.5, -4.0]), np.ones((2, 1)), 0.01, 1)
    late = noise_covariance(linear, np.array([5000]))[0, 0]
    np.testing.assert_allclose(late, stationary_covariance(linear)[0], rtol=1e-9, atol=1e-15)
    assert not late[2:].any()  # inputs have no noise
    np.testing.assert_allclose(root(late) @ root(late).T, late, atol=1e-15)


def test_relative_scale_is_by_standard_deviation_and_weighs_small_states_more():
    x = np.random.default_rng(0).normal((5.0, -3.0), (2.0, 0.1), (20, 5000, 2))
    scale = StateScale.of(x, "relative")
    np.testing.assert_allclose(scale(x).std((0, 1)), 1.0)
    np.testing.assert_allclose(scale(x).mean((0, 1)), 0.0, atol=1e-12)
    np.testing.assert_allclose(scale.weight(np.zeros(2)), 1 / LEAST)
    np.testing.assert_allclose(scale.weight(scale.scale * [3.0, 1.0]), 1 / (5.0 + LEAST))


def test_range_scale_maps_to_minus_one_to_one_with_equal_weights():
    x = np.random.default_rng(0).uniform((1.0, -3.0), (2.0, 7.0), (1000, 2))
    scale = StateScale.of(x, "range")
    np.testing.assert_allclose(scale(x).min(0), -1.0)
    np.testing.assert_allclose(scale(x).max(0), 1.0)
    assert (scale.weight(x) == 1).all()
    for scaling in ("relative", "range"):
        assert np.isfinite(StateScale.of(np.ones((10, 2)), scaling)(np.ones(2))).all()
