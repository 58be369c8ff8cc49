"""Observers that track: on a linear system they are a Kalman filter, which T_inv starts and starts again."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest
from error_bars import with_error_bars
from linear_system import C
from scipy.linalg import solve_discrete_are
from tracking import DT, PROCESS, STD, KalmanFilter, exact_flow, exact_motion, plain_observer, tracking_observer

import observers.observer as observer_module
from observers import MLP, Artifact, ArtifactError, Expression, Factors, KKLObserver, LinearFilter, load, unscented

LEVEL = 0.2
CLOSE = {"rtol": 1e-5, "atol": 1e-6}  # a network of floats says of a row what it says of it alone, but for rounding
OLD = 400  # samples: far beyond age_max, where T_inv is asked no more


def runs(steps=OLD, n=3, outputs=C):
    """States of the oscillator and their noisy outputs, (steps, n, .)."""
    rng, (Phi, _) = np.random.default_rng(0), exact_motion()
    x = np.empty((steps, n, 2))
    x[0] = rng.uniform(-1, 1, (n, 2))
    for k in range(1, steps):
        x[k] = x[k - 1] @ Phi.T + PROCESS * rng.standard_normal((n, 2))
    return x, x @ outputs.T + LEVEL * rng.standard_normal((steps, n, len(outputs)))


def followed(observer, outputs=C):
    """A Kalman filter for each row that stands where the observer does."""
    return [KalmanFilter(x, P, LEVEL, outputs) for x, P in zip(observer.decode(), observer.covariance, strict=True)]


def settled(outputs=C, **options):
    """An observer that T_inv tells nothing more, and the states and samples that come next."""
    observer = KKLObserver(tracking_observer(outputs, **options), LEVEL, process_noise=0.0)
    x, y = runs(steps=OLD + 200, outputs=outputs)
    observer.reset(y[0])
    for sample in y[1:OLD]:
        observer.step(sample)
    return observer, x[OLD:], y[OLD:]


def test_it_is_the_kalman_filter_of_a_linear_system():
    observer, _, y = settled()
    filters = followed(observer)
    for sample in y:
        found = observer.step(sample)
        expected = [each.step(row) for each, row in zip(filters, sample, strict=True)]
        np.testing.assert_allclose(found, expected, **CLOSE)
        np.testing.assert_allclose(observer.covariance, [each.P for each in filters], **CLOSE)
    Phi, _ = exact_motion()
    stationary = solve_discrete_are(Phi.T, C.T, PROCESS**2 * np.eye(2), [[LEVEL**2]])
    K = stationary @ C.T / (C @ stationary @ C.T + LEVEL**2)
    np.testing.assert_allclose(observer.covariance[0], (np.eye(2) - K @ C) @ stationary, rtol=1e-4)


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
    inverse = dataclasses.replace(sure.inverse, spread=dataclasses.replace(spread, mlp=low))
    observer, (_, y) = KKLObserver(dataclasses.replace(sure, inverse=inverse), LEVEL), runs()
    plain = KKLObserver(plain_observer(), LEVEL)
    observer.reset(y[0])
    plain.reset(y[0])
    old = round(sure.flow.window / DT)
    for k in range(1, old + 10):
        same = np.allclose(observer.step(y[k]), plain.step(y[k]))
        assert same == (k < old), k


def test_errors_are_those_of_the_covariance():
    x, y = runs(n=400, steps=200)
    observer = KKLObserver(tracking_observer(), LEVEL, process_noise=0.0)
    error, P = x - observer.estimate(y), observer.estimate_covariance(y)
    late = slice(100, None)
    np.testing.assert_allclose(
        (error**2)[late].mean((0, 1)), P[late].diagonal(axis1=-2, axis2=-1).mean((0, 1)), rtol=0.1
    )


def test_a_lost_estimate_is_found_again():
    observer, x, y = settled()
    jump = np.array([3.0, -2.0])
    sound, window = observer.std.max(), round(observer.artifact.flow.window / DT)
    for k in range(20):
        observer.step(y[k])
        np.testing.assert_allclose(observer.std.max(), sound, rtol=0.01)  # chance does not make it lost
    (Phi, _), away, widest, lost = exact_motion(), jump, 0.0, 0
    for k in range(20, 20 + 8 * window):
        moved, away = x[k] + away, Phi @ away
        found = observer.step(y[k] + (moved - x[k])[:, :1])
        widest, lost = max(widest, observer.std.max()), lost + (observer._tracker._mean_square == 1.0).sum()
    assert lost >= 3  # each of the rows at least once
    assert widest >= 0.98 * STD  # T_inv said it, and the jump has misled z, so that what it said was inflated
    assert np.abs(found - moved).max() < 0.3


def test_a_missing_sample_corrects_nothing():
    observer, _, y = settled()
    filters = followed(observer)
    for k, sample in enumerate(y[:40]):
        gone = k % 4 == 1
        found = observer.step(None if gone else sample)
        expected = [each.step(None if gone else row) for each, row in zip(filters, sample, strict=True)]
        np.testing.assert_allclose(found, expected, **CLOSE)


def test_one_of_two_outputs_may_be_missing():
    both = np.eye(2)
    observer, _, y = settled(both)
    filters = followed(observer, both)
    for k, sample in enumerate(y[:40]):
        sample[k % 3, k % 2] = np.nan
        expected = [each.step(row) for each, row in zip(filters, sample, strict=True)]
        np.testing.assert_allclose(observer.step(sample), expected, **CLOSE)


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


@pytest.mark.parametrize("t_is_there", [True, False])
def test_a_known_start_is_begun_with(t_is_there):
    artifact = tracking_observer() if t_is_there else dataclasses.replace(tracking_observer(), forward=None)
    observer, (x, y) = KKLObserver(artifact, LEVEL), runs()
    np.testing.assert_allclose(observer.reset(y[0], x[0]), x[0])
    assert (observer.std < 0.01).all()
    known = np.array([[0.4, 0.6]])
    observer.restart(y[1][:1], [True, False, False], known)
    np.testing.assert_allclose(observer.decode()[0], known[0])
    np.testing.assert_allclose(observer.estimate(y, x0=x[0])[0], x[0])
    for sample in y[1:5]:
        observer.step(sample)
    assert (observer.std[1:] < 0.1).all()  # T_inv, which is less sure, does not take over


def test_levels_change_while_it_runs():
    observer, _, y = settled()
    x_hat, P = observer.decode(), observer.covariance
    observer.measurement_noise = 0.5
    np.testing.assert_allclose(observer.decode(), x_hat)
    np.testing.assert_allclose(observer.covariance, P)
    single = KalmanFilter(x_hat[0], P[0], 0.5)
    np.testing.assert_allclose(observer.step(y[0])[0], single.step(y[0, 0]), **CLOSE)
    observer.process_noise = 3.0
    single.Q = (3.0 * PROCESS) ** 2 * np.eye(2)
    np.testing.assert_allclose(observer.step(y[1])[0], single.step(y[1, 0]), **CLOSE)


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


def test_batches_may_have_no_rows():
    observer = KKLObserver(tracking_observer(), LEVEL)
    for shape in ((0,), (2, 0)):
        observer.reset(np.zeros((*shape, 1)))
        assert observer.step(np.zeros((*shape, 1))).shape == (*shape, 2)
        assert observer.step(None).shape == (*shape, 2)
        assert observer.covariance.shape == (*shape, 2, 2)
        assert observer.estimate(np.zeros((3, *shape, 1))).shape == (3, *shape, 2)


def test_what_it_returns_is_the_callers():
    observer, *_ = settled()
    x_hat, P = observer.decode(), observer.covariance
    kept = x_hat.copy(), P.copy()
    x_hat += 1.0
    P += 1.0
    np.testing.assert_array_equal(observer.decode(), kept[0])
    np.testing.assert_array_equal(observer.covariance, kept[1])


def test_factors_make_covariances_larger():
    factors = Factors(np.array([0.0, 1.0]), np.array([0.0, 10.0]), np.array([[1.0, 1.0], [1.0, 16.0]]))
    (plain, *_), (wide, *_) = settled(), settled(factors=factors)
    # The logarithm is interpolated: age and level 0.2 of 1 give 16 ** (0.2 * 1) beyond the last age.
    np.testing.assert_allclose(wide.covariance, plain.covariance * 16**0.2, rtol=1e-9)
    np.testing.assert_array_equal(wide.decode(), plain.decode())


def doubting(doubt, factor=1.0):
    """Factors with a doubt, at all levels and ages."""
    return Factors(np.zeros(1), np.zeros(1), np.full((1, 1), factor), np.full((1, 1), doubt))


def test_a_covariance_in_doubt_says_less_of_what_goes_together():
    (plain, *_), (doubts, *_) = settled(), settled(factors=doubting(0.2, 3.0))
    apart = 1.0 - 0.2 * (1.0 - np.eye(2))
    np.testing.assert_allclose(doubts.covariance, 3.0 * apart * plain.covariance, rtol=1e-9)
    np.testing.assert_array_equal(doubts.decode(), plain.decode())


def test_covariances_are_calibrated_as_those_of_the_samples_that_were_there():
    ages, values, (_, y) = np.array([0.0, 2.0, 4.0]), np.array([9.0, 3.0, 1.0]), runs(steps=150)
    artifact = tracking_observer(factors=Factors(np.zeros(1), ages, values[None]))
    batch, sure, single = (KKLObserver(each, LEVEL) for each in (artifact, tracking_observer(), artifact))
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


def test_what_single_covariances_are_multiplied_with_is_not_kept_for_ever(monkeypatch):
    monkeypatch.setattr("observers.tracker.KEPT", 10)
    factors = Factors(np.zeros(1), np.array([0.0, 1e3]), np.array([[9.0, 1.0]]))
    (_, y), observer = runs(steps=60), KKLObserver(tracking_observer(factors=factors), LEVEL)
    whole = observer.estimate_covariance(y[:, 0])
    for k in range(60):
        observer.step(y[k, 0]) if k else observer.reset(y[k, 0])
        np.testing.assert_array_equal(observer.covariance, whole[k])
        assert len(observer._tracker._free_calibrated._scales) <= 10


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


@pytest.mark.parametrize("batch", [(), (3,)])
def test_t_inv_is_asked_once_a_sample(batch, monkeypatch):
    """What it said of the estimate is what error bars take, whichever rows have moved, begun anew or are lost."""
    observer = KKLObserver(tracking_observer(C), LEVEL, process_noise=0.0)
    other, window = copy.copy(observer), observer.artifact.flow.window / DT
    asked, estimate = [], type(observer._states).estimate

    def counted(decoders, *signals, **options):
        asked.append(decoders)
        return estimate(decoders, *signals, **options)

    monkeypatch.setattr(type(observer._states), "estimate", counted)
    y = runs(steps=round(window), n=3)[1]
    y = y if batch else y[:, 0]
    for each in (observer, other):
        each.reset(y[0])
    for k in range(1, len(y)):
        for each in (observer, other):
            asked.clear()
            rows = np.arange(3) != k % 3 if batch else None
            each.advance(y[k] + (50.0 if k == 5 else 0.0), rows=rows if k % 4 == 1 else None)
            if k == 7 and batch:
                each.restart(y[k][:1], np.arange(3) == 0)
            if each is other:
                each._tracker._heard = None
            else:
                before = len(asked)
                each.decode_covariance()
                if k % 4 != 1 and k != 7:  # of rows that stood still, or have begun anew, it is asked again
                    assert len(asked) == before == 1
        np.testing.assert_allclose(observer.covariance, other.covariance, rtol=1e-12)


@pytest.mark.parametrize("t_is_there", [True, False])
def test_nobody_asks_t_inv_of_a_start_that_is_known(t_is_there):
    artifact = tracking_observer(factors=doubting(0.3))
    artifact = artifact if t_is_there else dataclasses.replace(artifact, forward=None)
    observer, (x, y) = KKLObserver(artifact, LEVEL), runs()
    observer.reset(y[0], x[0])
    assert (observer.std < 0.01).all()
    observer.step(y[1])
    copied = copy.copy(observer)
    assert (copied.std < 0.1).all()
    observer.restart(y[1][:1], [True, False, False])
    assert (observer.std[0] > 0.2).all()
    assert (observer.std[1:] < 0.1).all()
    observer.restart(y[1][:1], [True, False, False], x[1][:1])
    assert (observer.std < 0.1).all()
    observer.reset(y[0])
    assert (observer.std > 0.2).all()


def test_doubts_make_sense():
    ages, ones = np.zeros(1), np.ones((1, 1))
    for doubt in (-ones, 1.1 * ones, np.nan * ones, np.ones(1), np.ones((2, 1, 1))):
        with pytest.raises(ValueError, match="doubt"):
            Factors(ages, ages, ones, doubt)


def test_factors_of_free_motion_hold_until_an_input_acts():
    one, four = (Factors(np.zeros(1), np.zeros(1), np.full((1, 1), value)) for value in (1.0, 4.0))
    artifact = tracking_observer(factors=one)
    linear = LinearFilter(artifact.filter.A, artifact.filter.B, DT, 1)
    weight = np.insert(artifact.inverse.mlp.weights[0], [3] * 3, 0.0, axis=1)  # which reads nothing of z_u
    bars = artifact.inverse.spread.mlp
    spread = dataclasses.replace(
        artifact.inverse.spread, mlp=MLP([np.zeros((4, 8)), bars.weights[1]], bars.biases, "tanh")
    )
    inverse = dataclasses.replace(
        artifact.inverse,
        mlp=MLP([weight], [np.zeros(2)], "tanh"),
        features=("z_y", "z_u", "measurement_noise", "age"),
        z_offset=np.zeros(6),
        whiten=np.eye(6),
        noise_gain=np.zeros(6),
        spread=spread,
    )
    flow = exact_flow(factors=one)
    driven = dataclasses.replace(
        artifact, filter=linear, inverse=inverse, flow=dataclasses.replace(flow, free_factors=four)
    )
    plain = dataclasses.replace(driven, flow=flow)
    observer, other = (KKLObserver(each, LEVEL) for each in (driven, plain))
    y = np.zeros((3, 1))
    observer.reset(y), other.reset(y)
    for u in ([0.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.0]):
        observer.step(y, np.array(u)[:, None]), other.step(y, np.array(u)[:, None])
    np.testing.assert_allclose(observer.covariance, other.covariance * np.array([4.0, 1.0, 4.0])[:, None, None])
    np.testing.assert_array_equal(observer.decode(), other.decode())


def test_estimates_stay_within_bounds_and_finite():
    artifact = tracking_observer()
    narrow = dataclasses.replace(artifact, flow=dataclasses.replace(artifact.flow, low=-np.ones(2), high=np.ones(2)))
    observer = KKLObserver(narrow, LEVEL)
    observer.reset(np.array([0.0]))
    for y in (1e14, -1e14, 0.0, 5.0, 1e14):
        x_hat = observer.step(np.array([y]))
        assert (np.abs(x_hat) <= 1.0 + 1e-12).all()
        assert np.isfinite(observer.covariance).all()


def test_a_flow_may_be_off_by_more_where_the_state_moves_far():
    """Its covariance is then that of a Kalman filter with as much more process noise, at each sample."""
    artifact = tracking_observer()
    bend, scale = np.array([0.4, 0.8]), artifact.flow.x_scale
    observer = KKLObserver(dataclasses.replace(artifact, flow=dataclasses.replace(artifact.flow, bend=bend)), LEVEL)
    plain, twice = KKLObserver(artifact, LEVEL), KKLObserver(artifact, LEVEL)
    for each in (observer, plain, twice):
        each.reset(np.array([3.0]))
        for _ in range(13):  # then T_inv is asked no longer
            each.step(np.array([3.0]))
    for _ in range(30):
        x = observer.decode()
        twice._tracker._state = observer._tracker._state.copy()
        twice.step(None)
        moved = ((twice.decode() - x) / scale) ** 2
        P = twice.covariance + np.diag((bend * moved.sum() * scale) ** 2)
        observer.step(None)
        np.testing.assert_allclose(observer.covariance, P, rtol=1e-6)
        plain.step(None)
    assert (observer.std > plain.std).all()


def test_bad_samples_change_nothing():
    observer, _, y = settled()
    x_hat = observer.decode()
    for bad in (y[0][:2], np.full((3, 1), np.inf)):
        with pytest.raises(ValueError, match="y "):
            observer.step(bad)
    np.testing.assert_array_equal(observer.decode(), x_hat)


def test_files_hold_it(tmp_path):
    path, artifact = tmp_path / "map.safetensors", tracking_observer(factors=doubting(0.25))
    artifact.save(path)
    _, y = runs(steps=30)
    again = KKLObserver(Artifact.read(path), LEVEL).estimate(y)
    np.testing.assert_allclose(again, KKLObserver(artifact, LEVEL).estimate(y), rtol=1e-6)
    np.testing.assert_array_equal(Artifact.read(path).flow.factors.doubt, [[0.25]])
    tracking_observer().save(path)
    assert Artifact.read(path).flow.factors.doubt is None
    plain_observer().save(path)
    assert Artifact.read(path).flow is None


def test_what_does_not_fit_is_refused(make_artifact):
    plain, flow = plain_observer(), tracking_observer().flow
    replace = dataclasses.replace
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
    for name, value in (
        ("x_scale", np.zeros(2)),
        ("error", -np.ones(2)),
        ("low", np.full(2, 50.0)),
        ("window", 0.0),
        ("window", np.nan),
        ("window", 1e308),
        ("least_process_noise", 1e200),
        ("polynomial", np.zeros((2, 4))),  # two states have 1, 3, 6, 10 monomials, and so on
        ("polynomial", np.zeros((2, 1))),
        ("polynomial", np.zeros((2, 1081))),  # of degree 45, which is beyond all measure
        ("polynomial", np.zeros((1, 4))),
        ("gain", np.ones(3)),
        ("least_measurement_noise", np.zeros(1)),
    ):
        with pytest.raises(ArtifactError):
            replace(flow, **{name: value})
    with pytest.raises(ArtifactError, match="kkl-gym tracking"):
        plain.require_flow()


def test_covariances_that_are_none_have_no_factor():
    P = np.stack([np.eye(2), np.diag([1.0, -1.0]), np.full((2, 2), np.nan), 4.0 * np.eye(2)])
    found = unscented.factor(P)
    np.testing.assert_allclose(found[[0, 3]], [np.eye(2), 2.0 * np.eye(2)])
    assert np.isnan(found[[1, 2]]).all()


@pytest.mark.parametrize("batch", [(), (3,)])
def test_where_nothing_was_there_t_inv_is_not_asked(batch, monkeypatch):
    observer = KKLObserver(tracking_observer(), LEVEL)
    observer.reset(np.zeros((*batch, 1)))

    def estimate(*_, **__):
        raise AssertionError("T_inv is asked")

    monkeypatch.setattr(type(observer._tracker._decoders), "estimate", estimate)
    for _ in range(3):
        observer.step(None)
    with pytest.raises(AssertionError, match="asked"):
        observer.step(np.zeros((*batch, 1)))


def test_without_numba_an_observer_that_was_compiled_goes_on(monkeypatch):
    kept = pickle.dumps(load("lorenz-small", compiled=True))
    monkeypatch.setattr(observer_module, "available", lambda: False)
    observer, y = pickle.loads(kept), np.ones((4, 1))
    found = np.array([observer.reset(y[0]), *(observer.step(sample) for sample in y[1:])])
    np.testing.assert_allclose(observer.estimate(y), found, rtol=1e-4, atol=1e-4)


def test_whether_a_covariance_has_a_factor_no_other_decides():
    small = np.diag([1.0, 1e-14])
    np.testing.assert_array_equal(unscented.factor(np.stack([small, -np.eye(2)]))[0], unscented.factor(small[None])[0])


def test_an_output_that_is_undefined_where_it_is_expected_loses_the_tracker():
    """x1 of the oscillator, written so that it is defined beyond -2 alone, after a start that is said to be there."""
    h = Expression([["+", ["**", ["sqrt", ["+", ["x", 0], 2.0]], 2.0], -2.0]])
    artifact = dataclasses.replace(tracking_observer(), C=None, h=h)
    observer, (x, y) = KKLObserver(artifact, LEVEL), runs(steps=60)
    observer.reset(y[0], np.full((3, 2), [-3.0, 0.0]))
    for sample in y[1:]:
        observer.step(sample)
    assert np.abs(observer.decode() - x[-1]).max() < 1.0
    observer.step(None)
    assert (observer._tracker._mean_square < observer._tracker._supervision.limit).all()  # nor where it is missing


def test_what_is_missing_corrects_nothing():
    """Also where the noise is small beside what is not known: one output of two says what it says alone."""
    rng = np.random.default_rng(0)
    x, P, H, R = rng.normal(size=(4, 3)), np.tile(np.eye(3), (4, 1, 1)), rng.normal(size=(2, 3)), 1e-14 * np.eye(2)

    def found(y, H, R):
        mean, covariance, white = unscented.conditioned(x, P, y - x @ H.T, H @ P @ H.T + R, P @ H.T)
        return mean, covariance, (white**2).sum(-1)

    y = rng.normal(size=(4, 2))
    y[:, 0] = np.nan
    for part, expected in zip(found(y, H, R), found(y[:, 1:], H[1:], R[1:, 1:]), strict=True):
        np.testing.assert_allclose(part, expected, rtol=1e-12, atol=1e-12)
    y[:] = np.nan
    for part, expected in zip(found(y, H, R), (x, P, np.zeros(4)), strict=True):
        np.testing.assert_array_equal(part, expected)


@pytest.mark.parametrize("nx", [1, 2, 3, 4, 6])
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


def test_a_copy_made_before_reset_goes_its_own_way():
    observer = KKLObserver(tracking_observer(), LEVEL)
    other = copy.copy(observer)
    x_hat = observer.reset(np.array([0.5]))
    other.reset(np.full((3, 1), -0.5))
    assert np.array_equal(observer.decode(), x_hat)


def test_a_copy_has_a_monitor_of_its_own():
    observer = load("van_der_pol", monitor=True)
    observer.reset(np.array([1.0]))
    for _ in range(300):
        observer.step(np.array([1.0]))
    score, other = observer.score, copy.copy(observer)
    for _ in range(300):
        other.step(np.array([5.0]))
    assert other.score > score
    assert observer.score == score
