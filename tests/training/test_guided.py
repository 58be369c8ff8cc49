"""The guided Kalman filter, where the Kalman filter and the observer are known in closed form."""

import numpy as np
import pytest
from linear_system import Autonomous, C, F, Oscillator, exact_observer
from random_artifacts import random_artifact
from scipy.linalg import expm

import training
from examples.research.benchmark.protocol import run
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from training.guided import GuidedKalmanFilter
from training.kalman import IteratedKalmanFilter, measurement_covariance

DT, NOISE = 0.05, 0.1
Q = np.diag([1e-4, 2e-4])


def guided(Q=Q, system=Oscillator, artifact=None, noise=NOISE):
    return GuidedKalmanFilter(
        system(), artifact=artifact or exact_observer(DT), measurement_noise=noise, process_noise=0.0, Q=Q
    )


def measured(n=3, steps=300, kick=None, seed=0):
    """States and noisy outputs of the oscillator; the first row jumps by ``kick`` in the middle."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(-1, 1, (n, 2))
    x = simulate(Oscillator(), x0, steps, DT)
    if kick is not None:
        x[steps // 2 :, :1] = simulate(Oscillator(), x[steps // 2, :1] + kick, steps - steps // 2, DT)
    return x, x[..., :1] + NOISE * rng.normal(size=(*x.shape[:-1], 1))


def kalman(x, P, y, C=C, R=NOISE**2):
    """Estimates and last covariance of the linear Kalman filter from a mean and a covariance on."""
    Phi, R, found = expm(F * DT), R * np.eye(len(C)), []
    for sample in y:
        x, P = Phi @ x, Phi @ P @ Phi.T + Q * DT
        if not np.isnan(sample).any():
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
            x, P = x + K @ (sample - C @ x), P - K @ C @ P
        found.append(x)
    return np.array(found), P


def test_once_started_it_is_the_kalman_filter():
    _, y = measured()
    ours = guided()
    x = run(ours, y[:100])[-1]
    P = ours.covariance
    found = np.array([ours.step(sample) for sample in y[100:]])
    for i in range(3):
        expected, last = kalman(x[i], P[i], y[100:, i])
        np.testing.assert_allclose(found[:, i], expected, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(ours.covariance[i], last, rtol=1e-7, atol=1e-9)
    assert not ours.restarts.any()


def test_the_covariance_of_a_taken_estimate_is_that_of_its_errors():
    """Runs from 2X with noise: of those whose filters begin with the observer, 400 say how far it is off."""
    rng = np.random.default_rng(1)
    x = simulate(Oscillator(), rng.uniform(-2, 2, (400, 2)), 100, DT)
    ours = guided(Q=1e4 * np.eye(2))
    errors = run(ours, x[..., :1] + NOISE * rng.normal(size=(101, 400, 1)))[-1] - x[-1]
    spread = errors.T @ errors / 400
    np.testing.assert_allclose(np.diag(ours.covariance[0]), np.diag(spread), rtol=0.4)
    assert (ours.covariance == ours.covariance[0]).all()


def test_after_a_jump_it_starts_again_from_the_observer_in_that_row_alone():
    x, y = measured(kick=(4.0, -3.0))
    sure = 1e-8 * np.eye(2)
    ours, alone = (
        guided(Q=sure),
        IteratedKalmanFilter(Oscillator(), DT, Q=sure, R=measurement_covariance(Oscillator(), NOISE)),
    )
    found, lost = run(ours, y), run(alone, y)
    assert ours.restarts[0] > 0
    assert not ours.restarts[1:].any()
    late = slice(-50, None)
    assert np.abs(found - x)[late].max() < 0.15
    assert np.abs(lost - x)[late, 0].max() > 1.0
    undisturbed = run(guided(Q=sure), measured()[1])
    np.testing.assert_allclose(found[:, 1:], undisturbed[:, 1:], rtol=1e-9, atol=1e-12)


def test_a_batch_is_its_rows_whatever_its_shape():
    _, y = measured(n=4, kick=(4.0, -3.0))
    whole = run(guided(), y)
    np.testing.assert_allclose(run(guided(), y.reshape(-1, 2, 2, 1)).reshape(whole.shape), whole, rtol=1e-12)
    for i in (0, 3):
        one = guided()
        np.testing.assert_allclose(run(one, y[:, i]), whole[:, i], rtol=1e-9, atol=1e-11)
        assert one.restarts.shape == ()


def test_some_rows_restart_and_others_go_on():
    _, y = measured()
    ours, rows = guided(), np.array([False, True, False])
    fresh = run(guided(), y[:40])
    run(ours, y[:40])
    ours.restart(y[0, rows], rows)
    found = [ours.step(np.where(rows[:, None], y[k], y[k + 39])) for k in range(1, 40)]
    np.testing.assert_allclose(np.array(found)[:, 1], fresh[1:, 1], rtol=1e-12)
    np.testing.assert_allclose(np.array(found)[:, ~rows], run(guided(), y[:79])[40:, ~rows], rtol=1e-12)


def test_missing_samples_are_predicted():
    _, y = measured()
    ours = guided()
    x, P = run(ours, y[:100])[-1], ours.covariance
    gappy = y[100:200].copy()
    gappy[10:25, 0] = np.nan
    gappy[40:45] = np.nan
    found = np.array([ours.step(None if np.isnan(sample).all() else sample) for sample in gappy])
    for i in range(3):
        np.testing.assert_allclose(found[:, i], kalman(x[i], P[i], gappy[:, i])[0], rtol=1e-7, atol=1e-9)
    assert not ours.restarts.any()


def test_a_map_that_nobody_trained_does_no_harm():
    """Its errors are known to be large, so that the filter is the Kalman filter, driven or not."""
    system, rng = get_system("van_der_pol"), np.random.default_rng(0)
    u = rng.uniform(-1, 1, (40, 2, 1)) * system.u_max
    x = simulate(system, rng.uniform(*system.box(), (2, 2)), 40, 0.01, u=u)
    y = system.output(x) + 0.5 * rng.normal(size=(41, 2, 1))
    how = {"Q": 1e-4 * np.eye(2)}
    ours = GuidedKalmanFilter(system, artifact=random_artifact(), dt=0.01, measurement_noise=0.5, **how)
    kalman = IteratedKalmanFilter(system, 0.01, R=0.25 * np.eye(1), **how)
    np.testing.assert_allclose(ours.reset(y[0]), kalman.reset(y[0]), rtol=1e-12)
    for k in range(40):
        np.testing.assert_allclose(ours.step(y[k + 1], u[k]), kalman.step(y[k + 1], u[k]), rtol=1e-12)
    assert (ours.restarts == 0).all()


def test_an_intensity_may_miss_symmetry_and_zero_by_rounding():
    rng = np.random.default_rng(0)
    for _ in range(3):
        F, B = rng.normal(size=(2, 2)), rng.normal(size=(2, 1))
        guided(Q=F @ np.diag([0.1, 0.2]) @ F.T)
        guided(Q=B @ B.T)


def test_what_ships_is_found_by_name_and_noise_beyond_the_map_is_taken():
    ours = training.GuidedKalmanFilter("van_der_pol", measurement_noise=3.0)
    x_hat = ours.reset([1.0])
    assert x_hat.shape == (2,)
    assert ours.covariance.shape == (2, 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"Q": np.eye(3)}, r"Q must be a symmetric, positive semidefinite matrix of shape \(2, 2\), got"),
        ({"Q": np.ma.masked_array(np.eye(2), np.eye(2) > 0)}, "Q holds masked entries"),
        ({"measurement_noise": (0.1, 0.2)}, "one for each of 1 outputs"),
        ({"process_noise": -1.0}, "process_noise must be a finite number, not negative, got -1.0"),
        ({"dt": 0.01}, "sampling interval dt = 0.05"),
        ({"artifact": "nothing"}, "nothing"),
        ({"system": Autonomous()}, "was made for the system 'oscillator'"),
        ({"system": 3}, "the system must be the name of one or a kkl_gym.System, got 3"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        GuidedKalmanFilter(**{"system": Oscillator(), "artifact": exact_observer(DT), **arguments})


def test_bad_samples_are_refused_and_change_nothing():
    _, y = measured()
    ours = guided()
    with pytest.raises(RuntimeError, match="call reset"):
        ours.step(y[0])
    with pytest.raises(RuntimeError, match="call reset"):
        _ = ours.covariance
    with pytest.raises(ValueError, match="the first sample must be there"):
        ours.reset([np.nan])
    run(ours, y[:10])
    for sample, u, message in (
        (y[10, 0], None, "y must have shape"),
        (np.ma.masked_array(y[10], [[True], [False], [False]]), None, "masked"),
        (y[10], np.zeros((2, 1)), "u must have shape"),
        (y[10], np.ones((3, 1)), "knows no inputs"),
    ):
        with pytest.raises(ValueError, match=message):
            ours.step(sample, u)
    for y0, rows in ((y[0], [True, False, False]), (y[0], [1, 1, 1]), ([[np.nan]], [True, False, False])):
        with pytest.raises(ValueError, match=r"y must have shape|rows must be boolean|y holds NaN"):
            ours.restart(y0, rows)
    np.testing.assert_array_equal(ours.step(y[10]), run(guided(), y[:11])[-1])
