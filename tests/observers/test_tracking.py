"""Tracking observers: on a linear system they equal a Kalman filter that T_inv initialises and re-initialises."""

import functools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from random_tracking import signals, tracking
from tracking import (
    DT,
    PROCESS,
    STD,
    KalmanFilter,
    exact_motion,
    linear_motion,
    of_t_inv,
    plain_observer,
    tracking_observer,
)

from observers import ArtifactError, Equations, Expression, Factors, KKLObserver, unscented
from observers.tracker import INFLATION, Supervision

LEVEL, WINDOW = 0.2, 10  # WINDOW: samples in which T_inv may take over
EXACT = {"rtol": 1e-9, "atol": 1e-11}
CLOSE = {"rtol": 1e-5, "atol": 1e-6}  # rounding of T_inv's float32 network


@functools.cache
def runs(steps=400, n=3, outputs=1):
    """States of the oscillator and their noisy outputs, (steps, n, .)."""
    rng, (Phi, _) = np.random.default_rng(0), exact_motion()
    x = np.empty((steps, n, 2))
    x[0] = rng.uniform(-1, 1, (n, 2))
    for k in range(1, steps):
        x[k] = x[k - 1] @ Phi.T + PROCESS * rng.standard_normal((n, 2))
    y = x @ np.eye(2)[:outputs].T + LEVEL * rng.standard_normal((steps, n, outputs))
    x.flags.writeable = y.flags.writeable = False
    return x, y


def settled(**options):
    """An observer long after the first window, and the next states and samples."""
    (x, y), observer = runs(), KKLObserver(tracking_observer(**options), LEVEL, process_noise=0.0)
    observer.reset(y[0])
    for sample in y[1:100]:
        observer.step(sample)
    return observer, x[100:], y[100:].copy()


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("by", ["equations", "flow"])
def test_it_is_the_kalman_filter_of_a_linear_system(by, outputs, known):
    """From the first sample on, with missing outputs and samples, and with changes of the noise levels."""
    H, (x, y) = np.eye(2)[:outputs], runs(outputs=outputs)
    y, artifact = y.copy(), of_t_inv(tracking_observer(H, by=by), 2.0)
    motion, observer = artifact.motion, KKLObserver(artifact, LEVEL, process_noise=0.0)
    begin = (
        (x[0], [np.diag((1e-3 * motion.x_scale) ** 2)] * 3) if known else ([motion.mean] * 3, [motion.covariance] * 3)
    )
    filters = [KalmanFilter(*each, LEVEL, H) for each in zip(*begin, strict=True)]
    found = observer.reset(y[0], x[0] if known else None)
    expected = [each.x if known else each.correct(row) for each, row in zip(filters, y[0], strict=True)]
    for k in range(1, 80):
        np.testing.assert_allclose(found, expected, **EXACT)
        np.testing.assert_allclose(observer.covariance, [each.P for each in filters], **EXACT)
        if outputs > 1:
            y[k, k % 3, k % 2] = np.nan
        if k == 40:
            observer.measurement_noise, observer.process_noise = 0.5, 3.0
            for each in filters:
                each.R, each.Q = 0.5**2 * np.eye(outputs), (3.0 * PROCESS) ** 2 * np.eye(2)
        missing = k % 4 == 1
        found = observer.step(None if missing else y[k])
        expected = [each.step(None if missing else row) for each, row in zip(filters, y[k], strict=True)]


def test_innovations_beyond_their_limits_inflate_the_covariance_or_let_t_inv_take_over():
    """A drifting sensor, with the tracker computed by hand."""
    artifact, (x, y) = tracking_observer(), runs()
    watch, plain = Supervision.of(artifact.motion, DT), KKLObserver(plain_observer(), LEVEL)
    observer = KKLObserver(artifact, LEVEL, process_noise=0.0)
    hand = KalmanFilter(x[0, 0], np.diag((1e-3 * artifact.motion.x_scale) ** 2), LEVEL)
    observer.reset(y[0, 0], x[0, 0])
    plain.reset(y[0, 0], x[0, 0])
    nis, trend, square, happened = 1.0, 0.0, 1.0, []
    for k in range(1, 400):
        sample = y[k, 0] + 1e-4 * max(k - 50, 0) ** 2
        hand.step(sample)
        nis += watch.share * (hand.white[0] ** 2 - nis)
        trend += watch.trend_share * (hand.white[0] - trend)
        square += watch.trend_square_share * (watch.trend_gain * trend**2 - square)
        observer.step(sample), plain.step(sample)
        if square > watch.trend_limit:
            hand.P, trend, square = INFLATION * hand.P, 0.0, 1.0
            happened.append("inflated")
        if nis > watch.limit:
            hand.x, hand.P = plain.decode(), STD**2 * np.eye(2)
            nis, trend, square = 1.0, 0.0, 1.0
            happened.append("taken over")
        np.testing.assert_allclose(observer.decode(), hand.x, **EXACT)
        np.testing.assert_allclose(observer.covariance, hand.P, **EXACT)
    assert {*happened} == {"inflated", "taken over"}


@pytest.mark.parametrize(("batch", "std"), [((), 1e-3), ((3,), 1e-3), ((3,), 2.0)])
def test_t_inv_takes_over_within_the_first_window_where_its_determinant_is_smaller(batch, std):
    artifact, (_, y) = of_t_inv(tracking_observer(), std), runs()
    observer, plain = (KKLObserver(each, LEVEL) for each in (artifact, of_t_inv(plain_observer(), std)))
    y = y[:, 0] if batch == () else y
    for k in range(WINDOW + 5):
        found, of_t_inv_alone = (each.step(y[k]) if k else each.reset(y[k]) for each in (observer, plain))
        surer = std < 1.0 and k < WINDOW
        assert np.allclose(found, of_t_inv_alone) == surer, k
        assert np.allclose(observer.covariance, plain.covariance) == surer, k


def test_an_output_that_is_undefined_at_the_prediction_re_initialises_the_tracker():
    """The output x1, written so that h is undefined below -2, with a wrong known start below -2."""
    h = Expression([["+", ["**", ["sqrt", ["+", ["x", 0], 2.0]], 2.0], -2.0]])
    observer, (x, y) = KKLObserver(replace(tracking_observer(), C=None, h=h), LEVEL), runs()
    observer.reset(y[0], np.full((3, 2), [-3.0, 0.0]))
    for sample in y[1:60]:
        observer.step(sample)
    assert np.abs(observer.decode() - x[59]).max() < 1.0
    assert np.abs(observer.step(None) - x[60]).max() < 1.0


def test_batches_are_rows_and_records_are_steps():
    artifact, (_, y) = tracking_observer(), runs(n=4, steps=60)
    batch = KKLObserver(artifact, LEVEL)
    record, covariances = batch.estimate(y.reshape(60, 2, 2, 1)), batch.estimate_covariance(y)
    for i in range(4):
        single = KKLObserver(artifact, LEVEL)
        for k in range(60):
            x_hat = single.step(y[k, i]) if k else single.reset(y[k, i])
            np.testing.assert_allclose(record[k, i // 2, i % 2], x_hat, **CLOSE)
            np.testing.assert_allclose(covariances[k, i], single.covariance, **CLOSE)
    with pytest.raises(RuntimeError, match="reset"):
        batch.decode()  # a record does not change the observer's own state
    for shape in ((0,), (2, 0)):
        batch.reset(np.zeros((*shape, 1)))
        assert batch.step(None).shape == batch.step(np.zeros((*shape, 1))).shape == (*shape, 2)
        assert batch.covariance.shape == (*shape, 2, 2)
        assert batch.estimate(np.zeros((3, *shape, 1))).shape == (3, *shape, 2)


def test_some_rows_advance_and_some_restart():
    observer, _, y = settled()
    rows = np.array([True, False, True])
    before, covariance = observer.decode(), observer.covariance
    observer.advance(y[0], rows=rows)
    np.testing.assert_array_equal(observer.decode()[1], before[1])
    np.testing.assert_array_equal(observer.covariance[1], covariance[1])
    assert (observer.decode()[rows] != before[rows]).all()
    np.testing.assert_array_equal(observer.decode(rows), observer.decode()[rows])
    np.testing.assert_array_equal(observer.decode_covariance(rows), observer.covariance[rows])
    moved = observer.decode()
    for x0 in (None, np.array([[0.3, 0.2]])):
        observer.restart(y[1][:1], ~rows, x0)
        fresh = KKLObserver(observer.artifact, LEVEL, process_noise=0.0)
        fresh.reset(y[1][:1], x0)
        for k in range(3):
            np.testing.assert_allclose(observer.decode()[1:2], fresh.decode(), **EXACT)
            np.testing.assert_allclose(observer.covariance[1:2], fresh.covariance, **EXACT)
            np.testing.assert_array_equal(observer.decode()[rows], moved[rows])
            observer.advance(np.broadcast_to(y[2 + k][:1], (3, 1)), rows=~rows)
            fresh.step(y[2 + k][:1])
    observer.restart(np.zeros((0, 1)), [False] * 3)


@pytest.mark.parametrize("t_is_there", [True, False])
def test_known_starts(t_is_there):
    artifact = tracking_observer()
    observer = KKLObserver(artifact if t_is_there else replace(artifact, forward=None), LEVEL)
    (x, y), sure = runs(), np.tile(1e-3 * artifact.motion.x_scale, (3, 1))
    np.testing.assert_allclose(observer.reset(y[0], x[0]), x[0])
    np.testing.assert_allclose(observer.std, sure)
    np.testing.assert_allclose(observer.estimate(y[:9], x0=x[0])[0], x[0])
    observer.measurement_noise = 0.9 * LEVEL
    observer.restart(y[1][:1], [True, False, False])
    assert (observer.std[0] > 0.1).all()
    np.testing.assert_allclose(observer.std[1:], sure[1:])  # T_inv has a larger covariance and does not take over
    with pytest.raises(ArtifactError, match="has no T, and the observer does not track"):
        KKLObserver(replace(artifact, forward=None), LEVEL, tracking=False).reset(y[0], x[0])


def test_maps_are_replaced_during_a_run():
    observer, x, y = settled()
    x_hat, P = observer.decode(), observer.covariance
    observer.replace(tracking_observer(by="flow", x_scale=(1.0, 3.0)))
    np.testing.assert_allclose(observer.decode(), x_hat)
    np.testing.assert_allclose(observer.covariance, P)
    observer.replace(plain_observer())
    assert not observer.tracking
    plain = observer.decode()
    observer.replace(of_t_inv(tracking_observer(), 1e-3))
    np.testing.assert_allclose(observer.decode(), plain)  # T_inv, with the smaller covariance, initialises the tracker
    observer.replace(plain_observer())
    observer.replace(tracking_observer())
    for k in range(50):
        observer.step(y[k])
    assert np.abs(observer.decode() - x[49]).max() < 0.3


def test_covariances_are_multiplied_by_factors_of_level_and_age():
    """Factors are interpolated in logarithms between ages; levels are fractions of the map's largest level, 1."""
    ages, values = np.array([0.0, 2.0, 4.0]), np.array([[9.0, 3.0, 1.0], [4.0, 8.0, 2.0]])
    factors = Factors(np.array([0.0, 2 * LEVEL]), ages, values[None])
    (_, y), rows = runs(), np.array([True, False, False])
    sure, wide = (KKLObserver(tracking_observer(**each), LEVEL) for each in ({}, {"factors": factors}))
    for k in range(100):
        for observer in (sure, wide):
            observer.step(y[k]) if k else observer.reset(y[k])
            if k == 50:
                observer.restart(y[k][:1], rows)
        age = DT * np.where(rows & (k >= 50), k - 50, k)
        expected = np.exp(np.interp(age, ages, np.log(values.mean(0))))
        np.testing.assert_allclose(wide.covariance, expected[:, None, None] * sure.covariance, rtol=1e-9)
    np.testing.assert_array_equal(wide.decode(), sure.decode())


@pytest.mark.parametrize("options", [{}, {"outputs": 2, "process": True, "free_inverse": True}], ids=str)
def test_tracking_false_equals_the_map_without_a_motion(options):
    artifact = tracking(**options)
    bare, (y, u) = replace(artifact, motion=None), signals(artifact, 30, (3,))
    y[5:9, 1], y[12, :, 0] = np.nan, np.nan
    one, other = KKLObserver(artifact, 0.1, tracking=np.False_), KKLObserver(bare, 0.1)
    assert (one.tracking, KKLObserver(artifact).tracking, other.tracking) == (False, True, False)
    for k in range(30):
        if k == 20:
            one.measurement_noise = other.measurement_noise = 0.3
            one.replace(artifact)
            one, other = (pickle.loads(pickle.dumps(each)) for each in (one, other))
        found = [each.step(y[k], u[k]) if k else each.reset(y[k]) for each in (one, other)]
        np.testing.assert_array_equal(*found)
        np.testing.assert_array_equal(one.covariance, other.covariance)
    for name in ("estimate", "estimate_covariance"):
        np.testing.assert_array_equal(*(getattr(each, name)(y, u) for each in (one, other)))
    with pytest.raises(ArtifactError, match="cannot track: it holds no model; kkl-gym train"):
        KKLObserver(bare, tracking=True)


def test_artifacts_with_a_motion_that_does_not_fit(make_artifact):
    plain, motion = plain_observer(), linear_motion()
    for wrong in (linear_motion(nu=1), linear_motion("flow", nu=1), linear_motion(ny=2)):
        with pytest.raises(ArtifactError, match="does not fit an observer of"):
            replace(plain, motion=wrong)
    for lacking in ({"inverse": replace(plain.inverse, error_covariance=None)}, {"C": None}):
        with pytest.raises(ArtifactError, match="needs T_inv's covariance and the output"):
            replace(plain, motion=motion, **lacking)
    with pytest.raises(ArtifactError, match="model must have fixed parameters, not ranges of k"):
        replace(plain, motion=motion, parameters={"k": 1.0}, parameter_ranges={"k": (0.9, 1.1)})
    with pytest.raises(ArtifactError, match="cannot track: it holds no model; kkl-gym train"):
        plain.require_motion()


@pytest.mark.parametrize("nx", [1, 3, 6])
def test_sigma_points_have_mean_and_covariance(nx):
    rng = np.random.default_rng(nx)
    root = rng.normal(size=(5, nx, nx))
    x, P = rng.normal(size=(5, nx)), root @ root.mT + np.eye(nx)
    A = rng.normal(size=(nx, nx))
    mean, covariance, across = unscented.transformed(x, P, lambda x: x @ A.T + 1.0)
    np.testing.assert_allclose(mean, x @ A.T + 1.0)
    np.testing.assert_allclose(covariance, A @ P @ A.T)
    np.testing.assert_allclose(across, P @ A.T)
    H, R = rng.normal(size=(2, nx)), np.diag([0.3, 0.7])
    y = rng.normal(size=(5, 2))
    expected, S, across = unscented.transformed(x, P, lambda x: x @ H.T)
    V, white = unscented.whitened(y - expected, S + R, across, np.isnan(y))
    found, left = unscented.shift(x, V, white), unscented.add(P, V, V, -1.0)
    nis = (white**2).sum(-1) / 2
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(found, x + (K @ (y - x @ H.T)[..., None])[..., 0])
    np.testing.assert_allclose(left, (np.eye(nx) - K @ H) @ P, rtol=1e-6, atol=1e-9)
    apart = y - x @ H.T
    np.testing.assert_allclose(nis, np.einsum("ni,nij,nj->n", apart, np.linalg.inv(S), apart) / 2)


def test_estimates_stay_within_bounds_and_finite():
    artifact = tracking_observer()
    wild = Equations(Expression([["*", 1e9, ["x", i]] for i in range(2)]), substeps=0)
    narrow = replace(artifact, motion=replace(artifact.motion, low=-np.ones(2), high=np.ones(2), equations=wild))
    observer = KKLObserver(narrow, LEVEL)
    observer.reset(np.array([0.0]))
    for y in (np.nan, 1e14, -1e14, 0.0, 5.0, 1e14):
        x_hat = observer.step(np.array([y]))
        assert (np.abs(x_hat) <= 1.0 + 1e-12).all()
        assert (observer.std < 2.0).all()
