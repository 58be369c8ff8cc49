"""The coordinates in which networks see z."""

import numpy as np

from training.maps.coordinates import coordinates, spread


def test_coordinates_make_the_signal_white_and_the_noise_diagonal():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(5000, 3)) @ np.array([[1.0, 1.0, 1.0], [0.0, 1e-3, 2e-3], [0, 0, 1e-5]]) + 7.0
    noise = np.diag([1e-3, 2e-3, 1e-3])
    found = coordinates(z, noise)
    np.testing.assert_allclose(np.cov(found(z).T, bias=True), np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found.whiten @ noise @ found.whiten.T, np.diag(found.noise_gain**2), atol=1e-3)
    assert (np.diff(found.noise_gain) >= 0).all()
    flat = coordinates(z[:, [0, 0, 0]], noise)
    assert len(flat.noise_gain) == 1  # two modes hold nothing but rounding


def test_spread_is_in_any_units_and_takes_rounding_for_rest():
    z = np.random.default_rng(0).normal(size=(1000, 3)) * [1e-20, 1.0, 1e-15] + [0.0, 1e6, 1.0]
    np.testing.assert_allclose(spread(z), [1e-20, 1.0, 1.0], rtol=0.1)
    assert (spread(np.zeros((10, 2))) == 1.0).all()
