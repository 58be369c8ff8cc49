"""Scaling of states, and weights of their errors."""

import numpy as np

from training.maps.scaling import LEAST, StateScale


def test_relative_scale_is_by_standard_deviation_and_weighs_small_states_more():
    x = np.random.default_rng(0).normal((5.0, -3.0), (2.0, 0.1), (20, 5000, 2))
    scale = StateScale.of(x, "relative")
    np.testing.assert_allclose(scale(x).std((0, 1)), 1.0)
    np.testing.assert_allclose(scale(x).mean((0, 1)), 0.0, atol=1e-12)
    np.testing.assert_allclose(scale.weight(np.zeros(2)), 1 / LEAST)
    np.testing.assert_allclose(scale.weight(scale.scale * [3.0, 1.0]), 1 / (5.0 + LEAST))


def test_range_scale_reaches_from_minus_one_to_one_and_weighs_all_alike():
    x = np.random.default_rng(0).uniform((1.0, -3.0), (2.0, 7.0), (1000, 2))
    scale = StateScale.of(x, "range")
    np.testing.assert_allclose(scale(x).min(0), -1.0)
    np.testing.assert_allclose(scale(x).max(0), 1.0)
    assert (scale.weight(x) == 1).all()


def test_states_that_never_change_are_not_divided_by_zero():
    for scaling in ("relative", "range"):
        assert np.isfinite(StateScale.of(np.ones((10, 2)), scaling)(np.ones(2))).all()
