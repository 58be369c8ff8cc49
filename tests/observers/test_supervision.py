"""Divergence detection: false alarms by chance, and biases of the estimate below the noise level."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from linear_system import C
from tracking import DT, STD, exact_motion, tracking_observer

from observers import KKLObserver
from observers.tracker import Supervision

LEVEL = 0.2


def supervision(window, ny=1):
    """Supervision with a given window; the rest of the motion does not matter."""
    return Supervision.of(SimpleNamespace(window=window * DT, least_measurement_noise=np.zeros(ny)), DT)


@pytest.mark.parametrize(("ny", "window"), [(1, 50), (2, 100)])
def test_limits_are_beyond_chance(window, ny):
    """Running means of independent innovations average 1 and rarely exceed their limits."""
    watch, rows, steps = supervision(window, ny), 1000, 25 * window
    rng = np.random.default_rng(0)
    trend, mean_square, trend_square = np.zeros((rows, ny)), np.ones(rows), np.ones(rows)
    found = []
    for k in range(steps):
        white = rng.standard_normal((rows, ny))
        trend += watch.trend_share * (white - trend)
        mean_square += watch.share * ((white**2).mean(-1) - mean_square)
        trend_square += watch.trend_square_share * (watch.trend_gain * (trend**2).mean(-1) - trend_square)
        if k >= 15 * window:
            found.append((mean_square.copy(), trend_square.copy()))
    (squares, trends), limits = np.moveaxis(found, 1, 0), (watch.limit, watch.trend_limit)
    for values, limit in zip((squares, trends), limits, strict=True):
        assert values.mean() == pytest.approx(1.0, abs=0.03)
        assert (values > limit).mean() < 6e-4
    assert (trends > watch.trend_limit).mean() > 1e-5  # the limit is not needlessly high


def test_a_window_may_be_a_single_sample():
    watch = supervision(0.1)
    assert watch.window == 1
    assert np.isfinite([watch.limit, watch.trend_limit, watch.trend_gain]).all()
    assert 1 < watch.trend_limit < 100


def followed(off, steps, set_again=False):
    """Errors and standard deviations, (steps, 2), of an overconfident estimate that starts with the error `off`."""
    (Phi, _), rng = exact_motion(), np.random.default_rng(3)
    artifact = tracking_observer()
    motion = replace(artifact.motion, window=2.5, process_noise=1e-3 * artifact.motion.process_noise)
    observer = KKLObserver(replace(artifact, motion=motion), LEVEL, process_noise=0.0)
    x, found = np.array([0.4, -0.3]), []
    observer.reset(C @ x, x0=x + off)
    for _ in range(steps):
        x = Phi @ x
        if set_again:
            observer.measurement_noise = LEVEL
        found.append((observer.step(C @ x + LEVEL * rng.standard_normal(1)) - x, observer.std))
    return map(np.array, zip(*found, strict=True))


@pytest.mark.parametrize("set_again", [False, True])
def test_a_bias_below_the_noise_level_inflates_the_covariance(set_again):
    """Setting the noise level during the run does not restart the detection."""
    error, std = followed(0.5 * LEVEL * np.ones(2), 2000, set_again)
    risen = std[1:] / std[:-1]
    assert risen.max() == pytest.approx(np.sqrt(10.0), rel=0.1)
    assert 1 <= (risen[:, 0] > 2).sum() <= 4
    assert std.max() < 0.5 * STD  # T_inv, with STD, does not re-initialise the tracker
    assert np.abs(error[:20]).max() > 0.09
    assert np.abs(error[-200:]).max() < 0.03
    assert (np.abs(error) / std)[-200:].max() < 4


def test_an_estimate_that_is_right_stays_as_sure():
    error, std = followed(np.zeros(2), 2000)
    assert (std[1:] < 1.1 * std[:-1]).all()
    assert np.abs(error).max() < 0.01


def test_the_equivalent_white_noise_level_is_right_for_coloured_noise():
    """docs/guides/tracking.md gives this rule: error and standard deviation of the filter are then consistent."""
    (Phi, _), rng, rho = exact_motion(), np.random.default_rng(7), 0.8
    artifact = tracking_observer()
    artifact = replace(artifact, motion=replace(artifact.motion, process_noise=0.1 * artifact.motion.process_noise))
    as_bad = LEVEL * np.sqrt((1 + rho) / (1 - rho))
    observers = [KKLObserver(artifact, level, process_noise=0.0) for level in (LEVEL, as_bad)]
    x, noise = rng.uniform(-1, 1, (50, 2)), LEVEL * rng.standard_normal((50, 1))
    errors: list[list[np.ndarray]] = [[], []]
    for observer in observers:
        observer.reset(x @ C.T + noise)
    for k in range(600):
        x = x @ Phi.T
        noise = rho * noise + np.sqrt(1 - rho**2) * LEVEL * rng.standard_normal((50, 1))
        for observer, of in zip(observers, errors, strict=True):
            found = observer.step(x @ C.T + noise) - x
            if k >= 200:
                of.append(np.array([found, found / observer.std]))
    wrong, right = (np.sqrt(np.mean(np.square(of), axis=(0, 2, 3))) for of in errors)  # errors, also in units of std
    assert right[0] < 0.8 * wrong[0]
    assert 0.8 < right[1] < 1.2
    assert wrong[1] > 1.5
