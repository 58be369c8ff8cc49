"""Observers that track: on a linear system they are a Kalman filter, which T_inv starts and starts again."""

import copy
import dataclasses
import functools
import pickle

import numpy as np
import pytest
from error_bars import with_error_bars
from linear_system import C
from scipy.linalg import solve_discrete_are
from tracking import DT, PROCESS, STD, KalmanFilter, exact_flow, exact_motion, plain_observer, tracking_observer

from observers import MLP, Artifact, ArtifactError, Expression, Factors, KKLObserver, LinearFilter, unscented

LEVEL = 0.2
CLOSE = {"rtol": 1e-5, "atol": 1e-6}  # a network of floats says of a row what it says of it alone, but for rounding
OLD = 400  # samples: far beyond age_max, where T_inv is asked no more
replace = dataclasses.replace


@functools.cache
def runs(steps=OLD, n=3, outputs=1):
    """States of the oscillator and their noisy outputs, (steps, n, .)."""
    rng, (Phi, _) = np.random.default_rng(0), exact_motion()
    x = np.empty((steps, n, 2))
    x[0] = rng.uniform(-1, 1, (n, 2))
    for k in range(1, steps):
        x[k] = x[k - 1] @ Phi.T + PROCESS * rng.standard_normal((n, 2))
    y = x @ np.eye(2)[:outputs].T + LEVEL * rng.standard_normal((steps, n, outputs))
    x.flags.writeable = y.flags.writeable = False
    return x, y


@functools.cache
def long_run(outputs):
    observer, (_, y) = (
        KKLObserver(tracking_observer(np.eye(2)[:outputs]), LEVEL, process_noise=0.0),
        runs(600, 3, outputs),
    )
    observer.reset(y[0])
    for sample in y[1:OLD]:
        observer.step(sample)
    return observer


def settled(outputs=1, **options):
    """An observer that T_inv tells nothing more, and the states and samples that come next."""
    observer, (x, y) = copy.copy(long_run(outputs)), runs(600, 3, outputs)
    if options:
        observer.replace(tracking_observer(**options))
    return observer, x[OLD:], y[OLD:].copy()


@pytest.mark.parametrize("outputs", [1, 2])
def test_it_is_the_kalman_filter_of_a_linear_system(outputs):
    """Also where outputs or samples are missing, and from where it is told other levels of noise."""
    H = np.eye(2)[:outputs]
    observer, _, y = settled(outputs)
    Phi, _ = exact_motion()
    stationary = solve_discrete_are(Phi.T, H.T, PROCESS**2 * np.eye(2), LEVEL**2 * np.eye(outputs))
    K = stationary @ H.T @ np.linalg.inv(H @ stationary @ H.T + LEVEL**2 * np.eye(outputs))
    np.testing.assert_allclose(observer.covariance[0], (np.eye(2) - K @ H) @ stationary, rtol=1e-4, atol=1e-9)
    filters = [KalmanFilter(x, P, LEVEL, H) for x, P in zip(observer.decode(), observer.covariance, strict=True)]
    for k, sample in enumerate(y[:80]):
        if outputs > 1:
            sample[k % 3, k % 2] = np.nan
        if k == 40:
            observer.measurement_noise, observer.process_noise = 0.5, 3.0
            for each in filters:
                each.R, each.Q = 0.5**2 * np.eye(outputs), (3.0 * PROCESS) ** 2 * np.eye(2)
        gone = k % 4 == 1
        found = observer.step(None if gone else sample)
        expected = [each.step(None if gone else row) for each, row in zip(filters, sample, strict=True)]
        np.testing.assert_allclose(found, expected, **CLOSE)
        np.testing.assert_allclose(observer.covariance, [each.P for each in filters], **CLOSE)


def test_t_inv_says_where_to_begin():
    artifact, (_, y) = tracking_observer(), runs()
    observer, plain = KKLObserver(artifact, LEVEL, process_noise=0.0), KKLObserver(plain_observer(), LEVEL)
    np.testing.assert_allclose(observer.reset(y[0]), plain.reset(y[0]))
    np.testing.assert_allclose(observer.std, np.full((3, 2), STD), rtol=1e-6)
    for sample in y[1:4]:  # nothing is surer than the filter once it has begun
        assert not np.allclose(observer.step(sample), plain.step(sample))


def test_t_inv_takes_over_where_it_is_surer():
    sure = tracking_observer()
    spread = sure.inverse.spread
    low = MLP(spread.mlp.weights, [spread.mlp.biases[0], np.array([-9.0, -9.0, 0.0])], "tanh")
    inverse = replace(sure.inverse, spread=replace(spread, mlp=low))
    observer, (_, y) = KKLObserver(replace(sure, inverse=inverse), LEVEL), runs()
    plain = KKLObserver(plain_observer(), LEVEL)
    observer.reset(y[0])
    plain.reset(y[0])
    old = round(sure.flow.window / DT)
    for k in range(1, old + 10):
        same = np.allclose(observer.step(y[k]), plain.step(y[k]))
        assert same == (k < old), k


class Counted(MLP):
    """A network that counts how often it is asked."""

    def __init__(self, mlp):
        super().__init__(mlp.weights, mlp.biases, mlp.activation)
        self.asked = []

    def __call__(self, inputs):
        self.asked.append(inputs)
        return super().__call__(inputs)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_t_inv_is_asked_once_a_sample_within_the_window(batch):
    artifact = tracking_observer()
    mlp, window = Counted(artifact.inverse.mlp), round(artifact.flow.window / DT)
    observer = KKLObserver(replace(artifact, inverse=replace(artifact.inverse, mlp=mlp)), LEVEL)
    y = np.zeros((*batch, 1))
    observer.reset(y)
    for k in range(1, 2 * window):
        mlp.asked.clear()
        missing = k == 5
        observer.step(None if missing else y)
        asked = len(mlp.asked)
        _ = observer.covariance
        if not missing:
            assert asked == len(mlp.asked) == (k <= window), k
        else:
            assert asked == 0


def test_errors_are_those_of_the_covariance():
    x, y = runs(n=100, steps=400)
    observer, late = KKLObserver(tracking_observer(), LEVEL, process_noise=0.0), slice(100, None)
    error, variance = [], []
    for k in range(400):
        x_hat = observer.step(y[k]) if k else observer.reset(y[k])
        error.append(x_hat - x[k])
        variance.append(observer.std**2)
    np.testing.assert_allclose(np.square(error[late]).mean((0, 1)), np.mean(variance[late], axis=(0, 1)), rtol=0.1)


def test_a_lost_estimate_is_found_again():
    observer, x, y = settled()
    sound, window = observer.std.max(), round(observer.artifact.flow.window / DT)
    for k in range(20):
        observer.step(y[k])
        np.testing.assert_allclose(observer.std.max(), sound, rtol=0.01)  # chance does not make it lost
    (Phi, _), away, widest = exact_motion(), np.array([3.0, -2.0]), np.zeros(3)
    for k in range(20, 20 + 8 * window):
        moved, away = x[k] + away, Phi @ away
        found = observer.step(y[k] + (moved - x[k])[:, :1])
        widest = np.maximum(widest, observer.std.max(-1))
    assert (widest >= 0.98 * STD).all()  # T_inv said it, and the jump has misled z, so that what it said was inflated
    assert np.abs(found - moved).max() < 0.3


def test_an_output_that_is_undefined_where_it_is_expected_loses_the_tracker():
    """x1 of the oscillator, written so that it is defined beyond -2 alone, after a start that is said to be there."""
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
        batch.decode()  # its own state is as it was
    for shape in ((0,), (2, 0)):
        batch.reset(np.zeros((*shape, 1)))
        assert batch.step(None).shape == batch.step(np.zeros((*shape, 1))).shape == (*shape, 2)
        assert batch.covariance.shape == (*shape, 2, 2)
        assert batch.estimate(np.zeros((3, *shape, 1))).shape == (3, *shape, 2)


def test_some_rows_move_and_some_begin_anew():
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
    observer.restart(y[1][:1], [False, True, False])
    fresh = KKLObserver(observer.artifact, LEVEL)
    np.testing.assert_allclose(observer.decode()[1], fresh.reset(y[1][0]))
    np.testing.assert_allclose(observer.std[1], [STD, STD])
    np.testing.assert_array_equal(observer.decode()[[0, 2]], moved[[0, 2]])
    observer.restart(np.zeros((0, 1)), [False] * 3)


def test_maps_are_replaced_while_it_runs():
    observer, *_ = settled()
    x_hat, P = observer.decode(), observer.covariance
    observer.replace(tracking_observer(x_scale=(1.0, 3.0)))
    np.testing.assert_allclose(observer.decode(), x_hat)
    np.testing.assert_allclose(observer.covariance, P)
    observer.replace(plain_observer())
    plain = observer.decode()
    assert not np.allclose(plain, x_hat)
    observer.replace(tracking_observer())
    np.testing.assert_allclose(observer.decode(), plain)  # it begins with what T_inv says
    observer.step(np.zeros((3, 1)))


def test_copies_and_pickles_go_on_alike():
    observer, _, y = settled()
    others = [pickle.loads(pickle.dumps(observer)), copy.deepcopy(observer), copy.copy(observer)]
    for sample in y[:5]:
        found = observer.step(sample)
        for other in others:
            np.testing.assert_array_equal(other.step(sample), found)
    fresh = KKLObserver(tracking_observer(), LEVEL)
    other = copy.copy(fresh)  # goes its own way from before a reset on
    x_hat = fresh.reset(np.array([0.5]))
    other.reset(np.full((3, 1), -0.5))
    np.testing.assert_array_equal(fresh.decode(), x_hat)


@pytest.mark.parametrize("t_is_there", [True, False])
def test_a_known_start_is_begun_with(t_is_there):
    artifact = tracking_observer(factors=doubting(0.3))
    observer = KKLObserver(artifact if t_is_there else replace(artifact, forward=None), LEVEL)
    (x, y), first = runs(), [True, False, False]
    np.testing.assert_allclose(observer.reset(y[0], x[0]), x[0])
    assert (observer.std < 0.01).all()
    np.testing.assert_allclose(observer.estimate(y[:9], x0=x[0])[0], x[0])
    observer.step(y[1])
    assert (copy.copy(observer).std < 0.1).all()
    observer.measurement_noise = 0.9 * LEVEL
    assert (observer.std < 0.1).all()
    observer.restart(y[1][:1], first)
    assert (observer.std[0] > 0.2).all()
    assert (observer.std[1:] < 0.1).all()  # T_inv, which is less sure, does not take over
    observer.restart(y[1][:1], first, x[1][:1])
    np.testing.assert_allclose(observer.decode()[0], x[1][0])
    assert (observer.std < 0.1).all()
    observer.reset(y[0])
    assert (observer.std > 0.2).all()


def doubting(doubt, factor=1.0):
    """Factors with a doubt, at all levels and ages."""
    return Factors(np.zeros(1), np.zeros(1), np.full((1, 1), factor), np.full((1, 1), doubt))


def test_factors_and_doubts_of_covariances():
    by_level = Factors(np.array([0.0, 1.0]), np.array([0.0, 10.0]), np.array([[1.0, 1.0], [1.0, 16.0]]))
    (plain, *_), (wide, *_), (doubts, *_) = settled(), settled(factors=by_level), settled(factors=doubting(0.2, 3.0))
    # The logarithm is interpolated: age and level 0.2 of 1 give 16 ** (0.2 * 1) beyond the last age.
    np.testing.assert_allclose(wide.covariance, plain.covariance * 16**0.2, rtol=1e-9)
    apart = 1.0 - 0.2 * (1.0 - np.eye(2))
    np.testing.assert_allclose(doubts.covariance, 3.0 * apart * plain.covariance, rtol=1e-9)
    for other in (wide, doubts):
        np.testing.assert_allclose(other.decode(), plain.decode(), rtol=1e-12)


def test_covariances_are_calibrated_as_those_of_the_samples_that_were_there():
    ages, values, (_, y) = np.array([0.0, 2.0, 4.0]), np.array([9.0, 3.0, 1.0]), runs(steps=150)
    artifact = tracking_observer(factors=Factors(np.zeros(1), ages, values[None]))
    batch, sure, single = (KKLObserver(each, LEVEL) for each in (artifact, tracking_observer(), artifact))
    y = y.copy()
    y[3:60, :2] = np.nan  # of two rows in three
    seen = np.zeros(3)
    for k, samples in enumerate(y):
        for observer in (batch, sure):
            observer.step(samples) if k else observer.reset(samples)
        missing = np.isnan(samples[:, 0])
        single.step(None if missing[1] else samples[1]) if k else single.reset(samples[1])
        seen += bool(k) & ~missing
        factors = np.exp(np.interp(seen * DT, ages, np.log(values)))
        np.testing.assert_allclose(batch.covariance, factors[:, None, None] * sure.covariance, rtol=1e-9)
        np.testing.assert_allclose(single.covariance, batch.covariance[1], **CLOSE)


@pytest.mark.parametrize("doubt", [0.1, 1.0])
def test_soon_after_a_start_t_inv_is_asked_what_errors_there_may_be(doubt):
    (_, y), artifact = runs(), tracking_observer(factors=doubting(doubt))
    batch, sure, plain = (KKLObserver(each, LEVEL) for each in (artifact, tracking_observer(), plain_observer()))
    single, window = KKLObserver(artifact, LEVEL), round(artifact.flow.window / DT)
    for k in range(window + 5):
        for observer in (batch, sure, plain):
            observer.step(y[k]) if k else observer.reset(y[k])
        single.step(y[k, 1]) if k else single.reset(y[k, 1])
        apart = plain.decode() - sure.decode()
        said = plain.covariance + apart[:, :, None] * apart[:, None, :]
        other = said if k < window else sure.covariance * np.eye(2)
        np.testing.assert_allclose(batch.covariance, (1 - doubt) * sure.covariance + doubt * other, rtol=1e-9)
        np.testing.assert_allclose(single.covariance, batch.covariance[1], **CLOSE)
        np.testing.assert_array_equal(batch.decode_covariance(np.array([True, False, True])), batch.covariance[::2])
    batch.restart(y[k][:1], [False, True, False])
    np.testing.assert_allclose(batch.std[1], [STD, STD])
    np.testing.assert_allclose(batch.covariance[::2], sure.covariance[::2] * (1 - doubt * (1 - np.eye(2))), rtol=1e-9)


def test_factors_of_free_motion_hold_until_an_input_acts():
    one, four = (Factors(np.zeros(1), np.zeros(1), np.full((1, 1), value)) for value in (1.0, 4.0))
    artifact = tracking_observer(factors=one)
    linear = LinearFilter(artifact.filter.A, artifact.filter.B, DT, 1)
    weight = np.insert(artifact.inverse.mlp.weights[0], [3] * 3, 0.0, axis=1)  # which reads nothing of z_u
    bars = artifact.inverse.spread.mlp
    spread = replace(artifact.inverse.spread, mlp=MLP([np.zeros((4, 8)), bars.weights[1]], bars.biases, "tanh"))
    inverse = replace(
        artifact.inverse,
        mlp=MLP([weight], [np.zeros(2)], "tanh"),
        features=("z_y", "z_u", "measurement_noise", "age"),
        z_offset=np.zeros(6),
        whiten=np.eye(6),
        noise_gain=np.zeros(6),
        spread=spread,
    )
    flow = exact_flow(factors=one)
    driven = replace(artifact, filter=linear, inverse=inverse, flow=replace(flow, free_factors=four))
    plain = replace(driven, flow=flow)
    observer, other = (KKLObserver(each, LEVEL) for each in (driven, plain))
    y = np.zeros((3, 1))
    observer.reset(y), other.reset(y)
    for u in ([0.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.0]):
        observer.step(y, np.array(u)[:, None]), other.step(y, np.array(u)[:, None])
    np.testing.assert_allclose(observer.covariance, other.covariance * np.array([4.0, 1.0, 4.0])[:, None, None])
    np.testing.assert_array_equal(observer.decode(), other.decode())


def test_estimates_stay_within_bounds_and_finite():
    artifact = tracking_observer()
    narrow = replace(artifact, flow=replace(artifact.flow, low=-np.ones(2), high=np.ones(2)))
    observer = KKLObserver(narrow, LEVEL)
    observer.reset(np.array([0.0]))
    for y in (1e14, -1e14, 0.0, 5.0, 1e14):
        x_hat = observer.step(np.array([y]))
        assert (np.abs(x_hat) <= 1.0 + 1e-12).all()
        assert np.isfinite(observer.covariance).all()


def test_a_flow_may_be_off_by_more_where_the_state_moves_far():
    """Its covariance is then that of a Kalman filter with as much more process noise, at each sample."""
    plain, bend = tracking_observer(), np.array([0.4, 0.8])
    observer = KKLObserver(replace(plain, flow=replace(plain.flow, bend=bend)), LEVEL)
    observer.reset(np.array([3.0]))
    for _ in range(13):  # then T_inv is asked no longer
        observer.step(np.array([3.0]))
    for _ in range(30):
        other, x = copy.copy(observer), observer.decode()
        other.replace(plain)
        moved = ((other.step(None) - x) / plain.flow.x_scale) ** 2
        P = other.covariance + np.diag((bend * moved.sum() * plain.flow.x_scale) ** 2)
        observer.step(None)
        np.testing.assert_allclose(observer.covariance, P, rtol=1e-6)
        assert (observer.std > other.std).all()


def test_bad_samples_change_nothing_and_what_is_returned_is_the_callers():
    observer, _, y = settled()
    x_hat, P = observer.decode(), observer.covariance
    kept = x_hat.copy(), P.copy()
    for bad in (y[0][:2], np.full((3, 1), np.inf)):
        with pytest.raises(ValueError, match="y "):
            observer.step(bad)
    x_hat += 1.0
    P += 1.0
    np.testing.assert_array_equal(observer.decode(), kept[0])
    np.testing.assert_array_equal(observer.covariance, kept[1])


def test_files_hold_it(tmp_path):
    path, artifact = tmp_path / "map.safetensors", tracking_observer(factors=doubting(0.25))
    artifact.save(path)
    _, y = runs()
    again, expected = (KKLObserver(each, LEVEL) for each in (Artifact.read(path), artifact))
    np.testing.assert_allclose(again.estimate(y[:30]), expected.estimate(y[:30]), rtol=1e-6)
    np.testing.assert_allclose(again.estimate_covariance(y[:30]), expected.estimate_covariance(y[:30]), rtol=1e-6)


def test_what_does_not_fit_is_refused(make_artifact):
    plain, flow = plain_observer(), tracking_observer().flow
    with pytest.raises(ArtifactError, match="does not fit an observer of"):
        replace(plain, flow=exact_flow())  # which has an input
    with pytest.raises(ArtifactError, match="error bars and the output"):
        replace(plain, inverse=replace(plain.inverse, spread=None), flow=flow)
    with pytest.raises(ArtifactError, match="error bars and the output"):
        replace(plain, C=None, flow=flow)
    with pytest.raises(ArtifactError, match="by process noise"):
        replace(plain, flow=replace(flow, factors=Factors(np.zeros(1), np.zeros(1), np.ones((2, 1, 1)))))
    uncertain = with_error_bars(make_artifact("van_der_pol", estimated=True))
    with pytest.raises(ArtifactError):
        replace(uncertain, C=C, flow=replace(exact_flow()))
    wrong = {
        "x_scale": [np.zeros(2)], "error": [-np.ones(2)], "low": [np.full(2, 50.0)], "window": [0.0, np.nan, 1e308],
        "least_process_noise": [1e200], "least_measurement_noise": [np.zeros(1)], "gain": [np.ones(3)],
        "polynomial": [np.zeros((2, 4)), np.zeros((2, 1)), np.zeros((2, 1081))],  # no 1, 3, 6, 10
    }  # fmt: skip
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(ArtifactError):
                replace(flow, **{name: value})
    with pytest.raises(ArtifactError, match="kkl-gym tracking"):
        plain.require_flow()
    ages, ones = np.zeros(1), np.ones((1, 1))
    for doubt in (-ones, 1.1 * ones, np.nan * ones, np.ones(1)):
        with pytest.raises(ValueError, match="doubt"):
            Factors(ages, ages, ones, doubt)


def test_covariances_that_are_none_have_no_factor():
    P = np.stack([np.eye(2), np.diag([1.0, -1.0]), np.full((2, 2), np.nan), 4.0 * np.eye(2)])
    found = unscented.factor(P)
    np.testing.assert_allclose(found[[0, 3]], [np.eye(2), 2.0 * np.eye(2)])
    assert np.isnan(found[[1, 2]]).all()
    small = np.diag([1.0, 1e-14])  # no other decides
    np.testing.assert_array_equal(unscented.factor(np.stack([small, -np.eye(2)]))[0], unscented.factor(small[None])[0])


@pytest.mark.parametrize("nx", [1, 3, 6])
def test_sigma_points_have_mean_and_covariance(nx):
    rng = np.random.default_rng(nx)
    root = rng.normal(size=(5, nx, nx))
    x, P = rng.normal(size=(5, nx)), root @ root.mT + np.eye(nx)
    A, Q = rng.normal(size=(nx, nx)), np.diag(rng.uniform(size=nx))
    mean, covariance = unscented.predicted(x, P, move=lambda points: points @ A.T + 1.0, Q=Q)
    np.testing.assert_allclose(mean, x @ A.T + 1.0)
    np.testing.assert_allclose(covariance, A @ P @ A.T + Q)
    H, R = rng.normal(size=(2, nx)), np.diag([0.3, 0.7])
    y = rng.normal(size=(5, 2))
    found, left, nis = unscented.corrected(x, P, y, output=lambda points: points @ H.T, R=R)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(found, x + (K @ (y - x @ H.T)[..., None])[..., 0])
    np.testing.assert_allclose(left, (np.eye(nx) - K @ H) @ P, rtol=1e-6, atol=1e-9)
    apart = y - x @ H.T
    np.testing.assert_allclose(nis, np.einsum("ni,nij,nj->n", apart, np.linalg.inv(S), apart) / 2)
