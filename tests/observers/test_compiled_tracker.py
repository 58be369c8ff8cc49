"""The tracker's machine code against NumPy, which is the reference."""

import copy
import pickle
import threading
from dataclasses import replace

import numpy as np
import pytest
from random_tracking import JUMPS, a_flow, signals, tracking

import observers
from observers import Expression, KKLObserver, LinearFilter, tracker_kernels
from observers.compiled_tracker import CompiledTracker
from observers.supervision import INFLATION, Supervision
from observers.thresholds import MANY_ROWS, SOON
from observers.unscented import conditioned, predicted

pytest.importorskip("numba")

ROWS = 200
MISSING, RESTART, LEVELS = 7, 60, 1150  # now and then, and once


def along(observer, y, u):
    """Estimates, covariances and how innovations are watched, with all that may happen on the way."""
    found = [], [], []
    batch, (steps, *_) = y.shape[1:-1], y.shape
    rng = np.random.default_rng(2)
    observer.reset(y[0])
    for k in range(1, steps):
        some = rng.random(batch) < 0.5
        sample = y[k].copy()
        if k % MISSING == 3 and y.shape[-1] > 1:
            sample[..., 0] = np.nan
        if k == LEVELS:
            observer.measurement_noise, observer.process_noise = 0.3, 0.5
        if k % RESTART == 20:
            observer.restart(y[k][some], some)
        if k % MISSING == 5:
            observer.advance(None, u[k - 1])
        elif k % 3 == 0:
            observer.advance(sample, u[k - 1], some)
        else:
            observer.advance(sample, u[k - 1])
        found[0].append(observer.decode())
        found[1].append(observer.covariance)
        found[2].append(observer._tracker._state[:, observer._tracker._end :].copy())
    return [np.array(each) for each in found]


def assert_alike(found, expected, flow, within=1e-4):
    """Estimates in units of their standard deviations, and covariances in units of themselves."""
    (x, P, watched), (x_expected, P_expected, watched_expected) = found, expected
    size = np.sqrt(P_expected.diagonal(0, -2, -1))
    assert np.isfinite(x_expected).all()
    assert np.abs((x - x_expected) / size).max() < within
    assert np.abs((P - P_expected) / (size[..., :, None] * size[..., None, :])).max() < within
    np.testing.assert_allclose(watched, watched_expected, rtol=within, atol=within)


def numpy_alone(monkeypatch):
    """Takes every batch for a small one."""
    for module in (observers.tracker, observers.decoder, observers.network, observers.filter):
        monkeypatch.setattr(module, "MANY_ROWS", 10**9)


@pytest.mark.parametrize(
    ("outputs", "inputs", "surer", "bend"), [(1, True, 0.0, None), (1, False, 0.0, 0.5), (2, True, 2.0, None)]
)
def test_two_thousand_single_samples(outputs, inputs, surer, bend):
    artifact = tracking(outputs, inputs, surer, bend)
    y, u = signals(artifact, 2000)
    one, other = (KKLObserver(artifact, 0.1, compiled=choice) for choice in (True, False))
    expected = along(other, y, u)
    found = along(one, y, u)
    assert one._tracker._machine is not None
    assert other._tracker._machine is None
    assert_alike(found, expected, artifact.flow)
    assert not np.array_equal(found[0], expected[0])  # not the same arithmetic


@pytest.mark.parametrize(("outputs", "bend"), [(1, 0.5), (2, None)])
def test_two_thousand_samples_of_many_rows(outputs, bend, monkeypatch):
    artifact = tracking(outputs, bend=bend)
    y, u = signals(artifact, 2000, (ROWS,))
    one, other = KKLObserver(artifact, 0.1), KKLObserver(artifact, 0.1)
    found = along(one, y, u)
    assert one._tracker._machine is not None
    numpy_alone(monkeypatch)
    expected = along(other, y, u)
    assert other._tracker._machine is None
    assert_alike(found, expected, artifact.flow)
    assert not np.array_equal(found[0], expected[0])


def test_rows_are_lost_found_and_taken_as_numpy_does_it(monkeypatch):
    """From the same states at each sample, so that nothing adds up: covariances of all sizes, some of them none."""
    artifact = tracking(2)
    steps = 60
    y, u = signals(artifact, steps, (ROWS,))
    y[20:25, ::3] += 9.0
    one, other = KKLObserver(artifact, 0.1), KKLObserver(artifact, 0.1)
    rng, seen = np.random.default_rng(0), np.zeros(3, dtype=int)
    one.reset(y[0])
    other.reset(y[0])
    for k in range(1, steps):
        tracker = one._tracker
        root = np.exp(rng.uniform(-3, 3, (ROWS, 1, 1))) * rng.normal(size=tracker._P.shape)
        tracker._P[::4] = (root @ root.mT)[::4]
        tracker._P[1::16] *= -1.0
        tracker._x[2::32, 0] = 1e308 * (-1) ** k
        other._z, other._y, other._age, other._tracker = one._z, one._y, one._age, copy.deepcopy(tracker)
        rows, before = rng.random(ROWS) < 0.8, tracker._x.copy()
        with monkeypatch.context() as patch:
            one.advance(y[k], u[k], rows)
            assert "_compiled" in vars(tracker)
            numpy_alone(patch)
            other.advance(y[k], u[k], rows)
            assert "_compiled" not in vars(other._tracker)
        beside = other._tracker
        assert np.array_equal(tracker._x[~rows], before[~rows])
        assert np.abs(tracker._x - beside._x).max() < 1e-4
        np.testing.assert_allclose(tracker._P, beside._P, rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(
            tracker._state[:, tracker._end :], beside._state[:, tracker._end :], rtol=1e-4, atol=1e-4
        )
        learned = np.minimum(tracker._seen, tracker._window)
        said = tracker._scaled(*tracker._said(one._z, one._age.astype(float), learned))[1]
        same = np.isclose(tracker._P, said, rtol=1e-3).all((1, 2))
        seen += same[rows].sum(), (tracker._mean_square[rows] == 1.0).sum(), (~same[rows]).sum()
    assert (seen > 100).all()


def test_outputs_that_are_missing_do_not_make_it_lost():
    """The mean square of innovations scatters no more where one output of two is never there."""
    artifact = tracking(2)
    y, u = signals(artifact, JUMPS[0], (ROWS,))
    observer = KKLObserver(artifact, 0.1)
    scatter = {}
    for missing in (False, True):
        observer.reset(y[0])
        found = []
        for k in range(1, len(y)):
            sample = y[k].copy()
            if missing:
                sample[:, 1] = np.nan
            observer.advance(sample, u[k])
            found.append(observer._tracker._mean_square.copy())
        scatter[missing] = np.std(found[100:])
    assert scatter[True] < 1.2 * scatter[False]


@pytest.mark.parametrize("compiled", [False, True])
def test_a_single_sample_is_a_row_of_a_batch(compiled):
    """Also where it is lost long after a reset: T_inv counts for no surer than it would be soon after one."""
    artifact, last = tracking(1), JUMPS[1] + 5
    y, u = signals(artifact, last, (3,))
    together = KKLObserver(artifact, 0.1)
    alone = [KKLObserver(artifact, 0.1, compiled=compiled) for _ in range(3)]
    together.reset(y[0])
    for observer, first in zip(alone, y[0], strict=True):
        observer.reset(first)
    found = 0
    for k in range(1, last):
        x_hat, std = together.step(y[k], u[k]), together.std
        for row, observer in enumerate(alone):
            assert np.abs((observer.step(y[k, row], u[k, row]) - x_hat[row]) / std[row]).max() < 1e-4
            np.testing.assert_allclose(observer.std, std[row], rtol=1e-4)
        found += (together._tracker._mean_square == 1.0).sum()
    assert found > 3


@pytest.mark.parametrize(("nx", "nu", "ny", "thin"), [(1, 0, 1, False), (5, 2, 3, False), (3, 1, 1, True)])
def test_steps_of_other_sizes(nx, nu, ny, thin):
    """A single sample's and a batch's, of one more row than any loop would like; of polynomials that lack terms too."""
    rng, flow = np.random.default_rng(nx), a_flow(nx, nu, ny)
    if thin:
        polynomial = 10 * flow.polynomial * (rng.random(flow.polynomial.shape) < 0.2)
        polynomial[0], polynomial[1, :-1], polynomial[1, -1] = 0.0, 0.0, 1e-3  # no term at all, and the last alone
        flow = replace(flow, polynomial=polynomial)
    C = rng.normal(size=(ny, nx))
    low, high = ((bound - flow.x_offset) / flow.x_scale for bound in (flow.low, flow.high))
    q, r = flow.variances(0.3, 0.1)
    linear = LinearFilter(np.array([[-1.0, 2.0], [-2.0, -1.0]]), rng.normal(size=(2, ny)), dt=0.1, nu=nu)
    watch = Supervision(10, share=0.1, limit=2.0, trend_share=0.4, trend_square_share=0.2, trend_limit=1.4)
    machine = CompiledTracker(flow, linear, C, watch, variances=(q, r))
    for n in (1, 129):
        x, root, u = rng.normal(size=(n, nx)), rng.normal(size=(n, nx, nx)), rng.normal(size=(n, nu))
        P, y, before = (
            root @ root.mT / 9 + 1e-6 * np.eye(nx),
            rng.normal(size=(n, ny)),
            rng.uniform(0.5, 2.0, (n, 3 + ny)),
        )
        y[::3, 0], y[::4] = np.nan, np.nan
        none = np.arange(n) % 10 == 5  # is a covariance there
        P[none] *= -1.0
        v = np.tile(u / flow.u_scale, (2 * nx, 1))

        def move(s):
            return flow.scaled(np.clip(s, low, high).reshape(-1, nx), v).reshape(s.shape)  # noqa: B023

        ahead = predicted(x, P, move=move, Q=np.diag(q))
        scaled = C * flow.x_scale
        across, seen = ahead[1] @ scaled.T, ahead[0] @ scaled.T + C @ flow.x_offset
        x_next, P_next, white = conditioned(*ahead, y - seen, scaled @ across + np.diag(r), across)
        state = np.column_stack([x, P.reshape(n, -1), before])
        if n == 1:
            z, last = rng.normal(size=linear.size), rng.normal(size=ny)
            x_hat, filled, z_next = machine.single(state, z, last, u[0], y[0])
            np.testing.assert_allclose(x_hat, flow.x_offset + flow.x_scale * state[0, :nx], rtol=1e-12)
            np.testing.assert_allclose(filled, np.where(np.isnan(y), seen, y)[0], rtol=1e-5, atol=1e-5)
            np.testing.assert_allclose(z_next, linear.advance(z, last, u[0], filled), rtol=1e-12)
        else:
            np.testing.assert_allclose(machine.advance(state, u, y, None)[1], seen, rtol=1e-5, atol=1e-5)
        there = ~np.isnan(y)
        counted = there.mean(-1)
        trend = np.where(there, before[:, 3:] + 0.4 * (white - before[:, 3:]), before[:, 3:])
        raised = 4.0 * (trend**2 * there).sum(-1) / np.maximum(there.sum(-1), 1)
        trend_square = before[:, 1] + 0.2 * counted * (raised - before[:, 1])
        agree = (trend_square > 1.4) & there.any(-1)
        assert n == 1 or 10 < agree.sum() < n - 10
        wanted = [
            np.clip(x_next, low, high),
            P_next * np.where(agree, INFLATION, 1.0)[:, None, None],
            before[:, 0] + 0.1 * counted * ((white**2).sum(-1) / np.maximum(there.sum(-1), 1) - before[:, 0]),
            np.where(agree, 1.0, trend_square),
            before[:, 2] + there.any(-1),
            np.where(agree[:, None], 0.0, trend),
        ]
        end = nx + nx**2
        parts = state[:, :nx], state[:, nx:end].reshape(P.shape), *state.T[end : end + 3], state[:, end + 3 :]
        begun = x, P, np.full(n, np.inf), *before.T[1:3], before[:, 3:]
        for one, other, start in zip(parts, wanted, begun, strict=True):
            other[none] = start[none]
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


def test_outputs_that_are_not_linear_stay_with_numpy():
    artifact = tracking(1)
    C = artifact.C[0].tolist()
    terms = ["+", *(["*", weight, ["x", i]] for i, weight in enumerate(C))]
    curved = replace(artifact, C=None, h=Expression([terms]))
    y, u = signals(artifact, 30)
    one, other = (KKLObserver(each, 0.1, compiled=True) for each in (artifact, curved))
    assert_alike(along(other, y, u), along(one, y, u), artifact.flow)
    assert one._tracker._machine is not None
    assert other._tracker._machine is None


def test_a_run_compiles_nothing_in_its_midst():
    """Whatever may come: inputs that are read-only or have strides, missing samples, restarts, a filter that is old."""
    artifact = tracking(2)
    tracker_kernels.kernels.cache_clear()
    observer = KKLObserver(artifact, 0.1, compiled=True)
    used = tuple(map(tuple, (artifact.flow.polynomial != 0).tolist()))
    kernels = tracker_kernels.kernels(artifact.flow.mlp.activation, artifact.nu, artifact.ny, 3, used)
    assert [len(kernel.signatures) for kernel in kernels] == [1, 0, 1]
    frozen, y = np.array([0.2]), np.array([0.1, 0.2])
    frozen.flags.writeable = False
    observer.reset(y)
    for u in (np.broadcast_to(0.3, (1,)), frozen, np.zeros((3, 2))[:1, 1], np.float32([0.1]), [0], None):
        observer.step(y, u)
    for sample in (None, [np.nan, 0.3], [np.nan, np.nan], np.full((2, 2), 0.1)[:, 1], [0, 0]):
        observer.advance(sample)
        observer.advance(sample, rows=np.array(True))
        observer.advance(sample, rows=np.broadcast_to(False, ()))
    observer.restart([y], np.array(True))
    observer.step(y + 1e6)
    observer._age = np.inf
    observer.step(y)
    assert [len(kernel.signatures) for kernel in kernels] == [1, 0, 1]


def test_a_long_simulation_is_compiled_at_a_reset():
    artifact = tracking(1)
    observer, y = KKLObserver(artifact, 0.1), np.array([0.1])
    observer.reset(y)
    for _ in range(SOON):
        observer.step(y)
    assert observer._tracker._machine is None
    observer.reset(y)
    assert observer._tracker._machine is not None
    observer.measurement_noise = 0.2
    assert observer._tracker._machine is not None


@pytest.mark.parametrize("batch", [(), (ROWS,)])
def test_who_stands_still_says_the_same(batch):
    """To the last bit: a copy, rows that take no sample in, and those beside rows that begin anew."""
    artifact = tracking(1)
    y, u = signals(artifact, 40, batch)
    observer = KKLObserver(artifact, 0.1, compiled=True)
    observer.reset(y[0])
    for k in range(1, 40):
        observer.step(y[k], u[k])
        x_hat, rows = observer.decode(), np.arange(ROWS) < 3 if batch else np.array(False)
        assert np.array_equal(copy.copy(observer).decode(), x_hat)
        observer.advance(y[k], rows=rows)
        assert np.array_equal(observer.decode()[~rows], x_hat[~rows])
        if batch:
            observer.restart(y[k][rows], rows)
            assert np.array_equal(observer.decode()[~rows], x_hat[~rows])


def test_machine_code_is_there_at_the_first_sample_and_in_copies():
    artifact = tracking(1)
    observer = KKLObserver(artifact, 0.1, compiled=True)
    made = vars(observer._tracker)["_compiled"]
    observer.reset(np.zeros(1))
    observer.step(np.zeros(1))
    assert vars(copy.copy(observer)._tracker)["_compiled"] is vars(observer._tracker)["_compiled"] is made


def test_one_row_of_a_batch_is_numpys():
    artifact = tracking(1)
    observer = KKLObserver(artifact, 0.1, compiled=True)
    observer.reset(np.zeros((1, 1)))
    assert observer._tracker._machine is None
    observer.reset(np.zeros((MANY_ROWS, 1)))
    assert observer._tracker._machine is not None


@pytest.mark.parametrize("batch", [(), (ROWS,)])
def test_machine_code_stays_when_an_observer_travels(batch):
    artifact = tracking(1)
    y, u = signals(artifact, 60, batch)
    observer = KKLObserver(artifact, 0.1, compiled=True)
    observer.reset(y[0])
    for k in range(1, 30):
        observer.step(y[k], u[k])
    assert "_compiled" in vars(observer._tracker)
    packed = pickle.dumps(observer)
    assert b"CompiledTracker" not in packed
    there, twin = pickle.loads(packed), copy.deepcopy(observer)
    expected = np.array([observer.step(y[k], u[k]) for k in range(30, 60)])
    for other in (there, twin):
        assert np.array_equal(np.array([other.step(y[k], u[k]) for k in range(30, 60)]), expected)
        np.testing.assert_array_equal(other.covariance, observer.covariance)


@pytest.mark.parametrize(("batch", "again"), [((), 10_000), ((ROWS,), 100)])
def test_observers_of_one_artifact_in_threads(batch, again):
    """Samples, and then the same prediction again and again, which takes little of Python's time beside the kernels."""
    artifact = tracking(1)
    y, u = signals(artifact, 100, batch)
    found = {}

    def work(i):
        observer = KKLObserver(artifact, 0.1 * (i + 1), compiled=True)
        observer.reset((1 + 0.1 * i) * y[0])
        for k in range(1, 100):
            observer.step((1 + 0.1 * i) * y[k], u[k])
        z, tracker = observer.z, observer._tracker
        if batch:
            ahead = {tracker.copied().advance(y[0], u[0]).tobytes() for _ in range(again)}
        else:
            nothing = np.full_like(y[0], np.nan)  # so that what is predicted takes its place
            ahead = {tracker.copied().step_single(z, y[0], u[0], nothing)[1].tobytes() for _ in range(again)}
        found[i] = observer.decode(), ahead

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i in range(4):
        x_hat, ahead = found.pop(i)
        work(i)
        assert np.array_equal(x_hat, found[i][0])
        assert len(ahead) == 1
        assert ahead == found[i][1]


def test_what_is_looked_at_stays_as_it_was():
    artifact = tracking(1)
    y, u = signals(artifact, 20)
    observer = KKLObserver(artifact, 0.1, compiled=True)
    seen = [observer.reset(y[0])]
    for k in range(1, 20):
        seen.extend([observer.step(y[k], u[k]), observer.covariance, observer.std])
        copies = [each.copy() for each in seen]
        seen[-3] += 1.0  # the caller's own
        copies[-3] += 1.0
        observer.decode()
        assert all(map(np.array_equal, seen, copies))
