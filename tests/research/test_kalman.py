"""Nonlinear Kalman filters against those of filterpy, and against the linear filter on linear systems."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints
from filterpy.kalman import UnscentedKalmanFilter as FilterpyUKF
from linear_system import Autonomous, C, F, Oscillator, TwoOutputs
from scipy.linalg import expm

from examples.research.derivatives import jacobian
from examples.research.methods.unscented import UnscentedKalmanFilter
from kkl_gym import get_system
from kkl_gym.elementary import sqrt
from kkl_gym.simulate import advance, simulate
from observers.estimator import Running
from training.kalman import ExtendedKalmanFilter, unknown_start


@pytest.fixture(params=[ExtendedKalmanFilter, UnscentedKalmanFilter])
def filters(request):
    return request.param


def running(filters, *arguments, **options):
    return Running(filters(*arguments, **options))


def of_the_oscillator(filters):
    start = np.array([0.2, -0.1]), np.array([[1.0, 0.3], [0.3, 0.5]])
    return running(filters, Oscillator(), 0.02, Q=np.diag([0.01, 0.02]), R=np.array([[0.3]]), start=start)


def of_van_der_pol(filters):
    return running(filters, get_system("van_der_pol"), 0.01, Q=0.01 * np.eye(2), R=0.01 * np.eye(1))


@pytest.mark.parametrize("driven", [False, True])
def test_nonlinear_filters_are_the_kalman_filter_on_a_linear_system(filters, driven):
    ours, dt, rng = of_the_oscillator(filters), 0.02, np.random.default_rng(0)
    y, u = rng.normal(size=(200, 3, 1)), rng.uniform(-0.5, 0.5, (200, 3, 1))
    found = [ours.reset(y[0])] + [ours.step(y[k], u[k] if driven else None) for k in range(1, 200)]
    Phi = expm(F * dt)
    held = np.linalg.solve(F, Phi - np.eye(2)) @ [[0.0], [1.0]]  # effect of an input that is constant over a sample
    for i in range(3):
        one = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
        one.F, one.B, one.H, one.Q, one.R = Phi, held, C, np.diag([0.01, 0.02]) * dt, np.array([[0.3]])
        one.x, one.P = np.array([[0.2], [-0.1]]), np.array([[1.0, 0.3], [0.3, 0.5]])
        for k in range(200):
            if k:
                one.predict(u=u[k, i, :, None] if driven else None)
            one.update(y[k, i])
            np.testing.assert_allclose(found[k][i], one.x[:, 0], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(ours.state.P[i], one.P, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", ["van_der_pol", "lorenz"])
def test_ekf_against_filterpy(name):
    system, dt = get_system(name), 0.01
    x0, P0 = unknown_start(system)
    Q, R = np.diag((0.01 * np.array(system.scale)) ** 2), 0.25 * np.eye(1)
    x = simulate(system, np.array([x0 + 0.1 * np.array(system.scale)]), 100, dt)
    y = system.output(x) + 0.5 * np.random.default_rng(0).normal(size=(101, 1, 1))
    found = running(ExtendedKalmanFilter, system, dt, Q=Q, R=R, start=(x0, P0)).along(y)

    def flow(state):
        return simulate(system, state, 1, dt)[1]

    one = FilterpyEKF(dim_x=system.nx, dim_z=1)
    one.x, one.P, one.Q, one.R = x0.copy(), P0.copy(), Q * dt, R
    rows = jacobian(system.h, system.nx)
    H = np.array([[row[j](*x0) if j in row else 0.0 for j in range(system.nx)] for row in rows])
    for k, value in enumerate(y[:, 0]):
        if k:
            around = one.x + 1e-5 * np.vstack([np.eye(system.nx), -np.eye(system.nx)])
            moved = flow(around)
            Phi = ((moved[: system.nx] - moved[system.nx :]) / 2e-5).T
            one.x, one.P = flow(one.x[None])[0], Phi @ one.P @ Phi.T + one.Q
        one.update(value, lambda _: H, lambda state: H @ state)
        np.testing.assert_allclose(found[k, 0], one.x, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["van_der_pol", "lorenz"])
def test_ukf_is_filterpys_to_rounding(name):
    system, dt = get_system(name), 0.01
    Q, R = np.diag((0.01 * np.array(system.scale)) ** 2), 0.25 * np.eye(1)
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (31, 3, system.nu)) * system.u_max
    x = simulate(system, rng.uniform(*system.box(), (3, system.nx)), 30, dt, u=u[1:])
    y = system.output(x) + 0.5 * rng.normal(size=(31, 3, 1))
    ours = running(UnscentedKalmanFilter, system, dt, Q=Q, R=R)
    found = [ours.reset(y[0])] + [ours.step(y[k], u[k]) for k in range(1, 31)]
    points = MerweScaledSigmaPoints(system.nx, alpha=1.0, beta=2.0, kappa=3.0 - system.nx)

    def flow(x, dt, u):
        return np.array(advance(system, x.tolist(), u.tolist(), [0.0] * system.nx, dt))

    for i in range(3):
        one = FilterpyUKF(system.nx, 1, dt, lambda x: np.array(system.h(x)), flow, points)
        one.x, one.P = unknown_start(system)
        one.Q, one.R = Q * dt, R
        one.sigmas_f = points.sigma_points(one.x, one.P)  # filterpy sets these in predict, which comes later
        for k in range(31):
            if k:
                one.predict(u=u[k, i])
            one.update(y[k, i])
            np.testing.assert_allclose(found[k][i], one.x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(ours.state.P[i], one.P, rtol=1e-9, atol=1e-10)


def test_some_rows_restart_and_others_go_on(filters):
    rng = np.random.default_rng(0)
    y = rng.normal(size=(20, 3, 1))
    alone, together, rows = of_the_oscillator(filters), of_the_oscillator(filters), np.array([False, True, False])
    whole = alone.along(y)
    together.reset(y[0])
    for k in range(1, 10):
        together.step(y[k])
    before = together.state.x.copy()
    together.restart(y[0, rows], rows)
    np.testing.assert_array_equal(together.state.x[~rows], before[~rows])
    np.testing.assert_array_equal(together.state.x[rows], whole[0, rows])
    for k in range(1, 10):
        together.advance(y[k], rows=rows)
    np.testing.assert_allclose(together.state.x, whole[9], rtol=1e-12)
    together.advance(y[10], rows=np.zeros(3, dtype=bool))
    np.testing.assert_allclose(together.state.x, whole[9], rtol=1e-12)


def test_a_filter_that_leaves_the_bounds_restarts_without_the_others(filters):
    y = np.random.default_rng(0).normal(size=(60, 2, 1))
    wild = y.copy()
    wild[1:4, 0] = np.array([1e9, 1e-9, 1e12])[:, None]
    whole = of_van_der_pol(filters).along(y)
    spoiled = of_van_der_pol(filters).along(wild)
    np.testing.assert_allclose(spoiled[:, 1], whole[:, 1], rtol=1e-12, atol=1e-12)
    assert np.isfinite(spoiled).all()
    x_hat = of_van_der_pol(filters).along(np.concatenate([wild[:4, :1], np.full((50, 1, 1), 0.5)]))
    assert abs(x_hat[-1, 0, 0] - 0.5) < 0.2


@pytest.mark.parametrize("P", [np.diag([1.0, -1e-3]), np.full((2, 2), np.nan)])
def test_a_ukf_restarts_only_the_row_with_an_invalid_covariance(P):
    observer, untouched = (of_van_der_pol(UnscentedKalmanFilter) for _ in range(2))
    y = np.array([[0.7], [-0.4]])
    for one in (observer, untouched):
        one.reset(y)
    observer.state.P[0] = P
    found, expected = observer.step(y), untouched.step(y)
    fresh = of_van_der_pol(UnscentedKalmanFilter).reset(y)
    np.testing.assert_allclose(found, [fresh[0], expected[1]], rtol=1e-12)
    assert np.isfinite(observer.state.P).all()
    assert np.abs(fresh[0] - expected[0]).max() > 1e-3


@dataclass(frozen=True)
class Level(Autonomous):
    """The oscillator with the output sqrt(x1 + 1.2), which is undefined below -1.2."""

    name: ClassVar[str] = "level"

    def h(self, x):
        return (sqrt(x[0] + 1.2),)


def test_samples_are_used_where_h_is_undefined_at_some_sigma_points(filters):
    """The states stay where h is defined, but some sigma points of the wide initial covariance do not."""
    system, dt, rng = Level(), 0.02, np.random.default_rng(0)
    x = simulate(system, rng.uniform(-0.7, 0.7, (20, 2)), 500, dt)
    y = system.output(x) + 0.01 * rng.normal(size=(501, 20, 1))
    wide = np.zeros(2), np.eye(2)
    ours = running(filters, system, dt, Q=1e-6 * np.eye(2), R=1e-4 * np.eye(1), start=wide)
    for k, sample in enumerate(y):
        x_hat = ours.step(sample) if k else ours.reset(sample)
    assert np.abs(x_hat - x[-1]).max() < 0.05


def test_a_sample_that_is_missing_begins_no_row(filters):
    ekf = running(filters, Oscillator(), 0.02, Q=np.eye(2), R=np.eye(1)).estimator
    state = ekf.advance(ekf.start(2), np.array([[np.nan], [0.3]]))
    assert state.begun.tolist() == [False, True]
    np.testing.assert_array_equal(state.x[0], ekf.start(1).x[0])


def test_missing_outputs_correct_nothing(filters):
    """With NaN as the second output the filter equals that of the first output; without outputs it only predicts."""
    start, Q, dt = (np.array([0.2, -0.1]), np.array([[1.0, 0.3], [0.3, 0.5]])), np.diag([0.01, 0.02]), 0.02
    both = running(filters, TwoOutputs(), dt, Q=Q, R=np.diag([0.3, 0.4]), start=start)
    one = running(filters, Oscillator(), dt, Q=Q, R=np.array([[0.3]]), start=start)
    y = np.random.default_rng(0).normal(size=(30, 3, 1))
    found = both.along(np.concatenate([y, np.full_like(y, np.nan)], -1))
    np.testing.assert_allclose(found, one.along(y), rtol=1e-8, atol=1e-10)
    x, P = both.state.x, both.state.P
    both.advance(np.full((3, 2), np.nan))
    Phi = expm(F * dt)
    np.testing.assert_allclose(both.state.x, x @ Phi.T, rtol=1e-8)
    np.testing.assert_allclose(both.state.P, Phi @ P @ Phi.T + Q * dt, rtol=1e-7)


def test_noise_of_each_row_beside_a_missing_output():
    system, R = TwoOutputs(), np.array([[0.3, 0.1], [0.1, 0.2]])
    y = np.random.default_rng(0).normal(size=(20, 3, 2))
    y[5:9, 1, 0] = np.nan
    alike, each = (
        running(ExtendedKalmanFilter, system, 0.02, Q=0.01 * np.eye(2), R=of).along(y)
        for of in (R, np.tile(R, (3, 1, 1)))
    )
    np.testing.assert_allclose(each, alike, rtol=1e-12)
