"""Compiled steps against the reference in NumPy."""

import copy
import functools
import importlib
import itertools
import pickle
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from error_bars import with_error_bars
from random_artifacts import random_artifact
from random_tracking import JUMPS, KINDS, signals, tracking

import observers
from observers import MLP, Expression, KKLObserver

numba = pytest.importorskip("numba")
importlib.import_module("numba.core.event")

ACCURATE = 1e-5
ROWS = 12
REFERENCE = {"tanh": np.tanh, "silu": lambda h: h / 2 * (1 + np.tanh(h / 2)), "relu": lambda h: np.maximum(h, 0.0)}


FLOW = functools.partial(tracking, by="flow")
EQUATIONS = functools.partial(tracking, outputs=2, surer=-1.0, nonlinear=True)


def static():
    return with_error_bars(random_artifact(free_inverse=True, process=True))


def along(observer, y, u, masks):
    """Estimates and covariances along a record with gaps, restarts, masked rows and changes of noise levels."""
    found, batch = [], y.shape[1:-1]
    observer.reset(y[0])
    for k in range(1, len(y)):
        sample, some = y[k].copy(), masks[k]
        if k % 7 == 3 and y.shape[-1] > 1:
            sample[..., 0] = np.nan
        if k == 50:
            observer.measurement_noise, observer.process_noise = 0.3, 0.15
        if k % 60 == 20:
            observer.restart(y[k][some], some)
        rows = some if k % 3 == 0 else None
        observer.advance(None if k % 7 == 5 else sample, u[k - 1], rows)
        x_hat, covariance = observer.decode(), observer.covariance
        if batch and k % 10 == 0:
            np.testing.assert_allclose(observer.decode(some), x_hat[some], rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(observer.decode_covariance(some), covariance[some], rtol=1e-3, atol=1e-9)
        found.append((x_hat, covariance))
    return tuple(map(np.array, zip(*found, strict=True)))


def assert_alike(found, expected, within):
    """Compare estimates in units of their standard deviations, and covariances in units of the variances."""
    (x, P), (x_expected, P_expected) = found, expected
    size = np.sqrt(P_expected.diagonal(0, -2, -1))
    assert np.isfinite(x_expected).all()
    assert np.abs((x - x_expected) / size).max() < within
    assert np.abs((P - P_expected) / (size[..., :, None] * size[..., None, :])).max() < within


def record(artifact, steps, batch=()):
    rng = np.random.default_rng(2)
    if artifact.motion is not None:
        return *signals(artifact, steps, batch), rng.random((steps, *batch)) < 0.5
    y, u = rng.normal(size=(steps, *batch, artifact.ny)), rng.normal(size=(steps, *batch, artifact.nu))
    u[: steps // 3] = u[:, : batch[0] // 2 if batch else 0] = 0.0  # free motion
    return np.cumsum(0.3 * y, axis=0), u, rng.random((steps, *batch)) < 0.5


@pytest.mark.parametrize("batch", [(), (ROWS,)])
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_records_with_gaps_restarts_masks_and_new_levels(kind, batch):
    """The tolerance is that of T_inv's float32 networks."""
    artifact = tracking(**kind)
    y, u, masks = record(artifact, 200 if batch else JUMPS[1] + 100, batch)
    if batch:
        y[150:155, ::3] += 9.0  # makes trackers diverge
    found, expected = (along(KKLObserver(artifact, 0.1, compiled=choice), y, u, masks) for choice in (True, False))
    assert_alike(found, expected, 1e-3)
    assert not np.array_equal(found[1], expected[1])  # compiled steps round differently


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.get("by") != "flow"], ids=str)
def test_trackers_agree_to_rounding(kind):
    """A T_inv with large covariances never takes over; a record with gaps, and steps of several rows at once."""
    artifact = tracking(**{**kind, "surer": -9.0})
    y, u, _ = record(artifact, 200, (ROWS,))
    y[5::7] = y[3::5, 1, 0] = np.nan
    fast, slow = (KKLObserver(artifact, 0.1, compiled=choice) for choice in (None, False))
    found, expected = ((each.estimate(y, u), each.estimate_covariance(y, u)) for each in (fast, slow))
    assert_alike(found, expected, 1e-9)
    fast.reset(y[0])
    steps = [(fast.step(y[k], u[k - 1]), fast.covariance) for k in range(1, len(y))]
    assert_alike(tuple(map(np.array, zip(*steps, strict=True))), [each[1:] for each in expected], 1e-9)


def constant(inverse):
    """A T_inv whose last layer ignores its inputs, so that float32 adds no rounding."""
    *weights, last = inverse.mlp.weights
    return replace(inverse, mlp=MLP([*weights, 0.0 * last], inverse.mlp.biases, inverse.mlp.activation))


def mixed(observer, y, u, rows):
    """Estimates and covariances of some rows of a batch that start at different times, have gaps, gates and jumps."""
    y, u = y[:, rows], u[:, rows]
    found = [(observer.reset(y[0]), observer.covariance)]
    for k in range(1, len(y)):
        starts, waits = (rows + k) % 80 == 20, (3 * rows + k) % 5 == 0
        observer.restart(y[k, starts], starts)
        observer.advance(y[k], u[k - 1], ~starts & ~waits)
        observer.advance(None, u[k - 1], waits, dt=0.02)
        found.append((observer.decode(), observer.covariance))
    return tuple(map(np.array, zip(*found, strict=True)))


@pytest.mark.parametrize(("kind", "gate"), [(KINDS[0], None), (KINDS[5], 4.0), (KINDS[7], 4.0)], ids=str)
def test_rows_of_all_ages_agree_to_rounding(kind, gate):
    """Seventeen rows fill two groups of vector lanes and a part of a third; no row depends on its neighbours."""
    artifact = tracking(**kind)
    y, u, _ = record(artifact, 90, (17,))
    maps = {name: constant(each) for name in ("inverse", "free_inverse") if (each := getattr(artifact, name))}
    artifact = replace(artifact, **maps)
    rows, k = np.arange(17), np.arange(90)[:, None]
    gaps = np.random.default_rng(4).random(y.shape) < 0.2
    gaps[0] = gaps[(rows + k) % 80 == 20] = False  # first samples must be complete
    y[70, ::4] += 3.0
    y[gaps] = np.nan
    fast, slow = (KKLObserver(artifact, 0.1, gate=gate, compiled=choice) for choice in (True, False))
    found, expected = (mixed(each, y, u, rows) for each in (fast, slow))
    assert_alike(found, expected, 1e-9)
    if gate is not None:
        assert fast.rejected.sum() > 0
        np.testing.assert_array_equal(fast.rejected, slow.rejected)
    some = rows[[2, 3, 16]]
    for whole, part in zip(found, mixed(fast, y, u, some), strict=True):
        np.testing.assert_allclose(part, whole[:, some], rtol=1e-12, atol=1e-12)


def test_undefined_outputs_may_be_missing():
    """The tracker predicts with missing outputs even at states where h is undefined."""
    artifact = tracking(outputs=2, nonlinear=True)
    h = Expression([artifact.h.components[0], ["log", ["+", 1.0, ["x", 0]]]])
    found = []
    for choice in (True, False):
        observer = KKLObserver(replace(artifact, h=h), 0.1, compiled=choice)
        observer.reset(np.zeros((2, 2)), np.array([[-6.0, 0.0], [-7.0, 0.5]]))
        found.append([observer.step(None, np.full((2, 1), 0.3)) for _ in range(5)])
    np.testing.assert_allclose(*found, rtol=1e-9)


def test_compiled_steps_refuse_other_sizes(monkeypatch):
    """Compiled code would read beyond the arrays or overflow the stack; without a compiler, NumPy takes over."""
    estimator = KKLObserver(EQUATIONS(), 0.1, compiled=True).estimator
    state = estimator.advance(estimator.start(3), np.zeros((3, 2)))
    for rows, y, u in ((3, (2, 2), (2, 1)), (3, (3, 2), (2, 1)), (3, (3, 1), (3, 1)), (2, (3, 2), (3, 1))):
        with pytest.raises(ValueError, match="must have shapes"):
            estimator.advance(state[:rows], np.zeros(y), np.zeros(u))
    monkeypatch.setattr(observers.compiled_step, "MOST_ROWS", 1)
    assert KKLObserver(EQUATIONS(), 0.1).estimator._machine is None
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    assert not observers.machine.available.__wrapped__()


@pytest.mark.parametrize("make", [EQUATIONS, FLOW, static], ids=["equations", "flow", "static"])
@pytest.mark.parametrize("batch", [(), (3,)])
def test_records_are_steps(make, batch):
    artifact = make()
    y, u, _ = record(artifact, 100, batch)
    y[5::7] = np.nan
    observer = KKLObserver(artifact, 0.1)
    steps = [observer.reset(y[0]), *(observer.step(y[k] if k % 7 != 5 else None, u[k - 1]) for k in range(1, 100))]
    found, whole = observer.decode(), observer.estimate(y, u)
    np.testing.assert_allclose(whole, steps, rtol=1e-4, atol=1e-5)
    if artifact.motion is not None:
        assert np.array_equal(whole, steps)
    assert np.array_equal(observer.decode(), found)


def test_known_starts_and_parameters():
    artifact = replace(with_error_bars(random_artifact(estimated=True)), forward=random_artifact(forward=True).forward)
    y, u, _ = record(artifact, 30)
    found = []
    for choice in (True, False):
        observer = KKLObserver(artifact, compiled=choice)
        steps = [observer.reset(y[0], [0.3, 0.2])]
        for k in range(1, 30):
            steps += [observer.step(y[k], u[k]), observer.std, np.tile(observer.parameters_hat, 2)]
        found.append(np.array(steps))
    np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", observers.shipped())
def test_100_000_samples_of_every_shipped_map(name):
    from exported_steps import apart_at_all_levels

    def compiled(exported, y, u):
        levels = {"measurement_noise": exported.measurement_noise, "process_noise": exported.process_noise}
        observer = KKLObserver(exported.artifact, **levels, compiled=True)
        return np.array([observer.reset(y[0]), *(observer.step(y[k], u[k - 1]) for k in range(1, len(y)))])

    of_range, of_scale = apart_at_all_levels(name, "float", compiled)
    print(f"{name}: {of_range:.1e} of the range, {of_scale:.1e} of the scale")
    assert of_range < 1e-5


@pytest.mark.parametrize("activation", sorted(REFERENCE))
@pytest.mark.parametrize("width", [5, 16])
def test_networks(activation, width):
    """Also widths that are no multiple of the vector lanes, and inputs far into the flat parts of the activation."""
    rng = np.random.default_rng(0)
    sizes = [3, width, width + 1, 2]
    mlp = MLP(
        [rng.normal(size=(outputs, inputs)) for inputs, outputs in itertools.pairwise(sizes)],
        [rng.normal(size=outputs) for outputs in sizes[1:]],
        activation,
    )
    x = (5 * rng.normal(size=(300, 3))).astype(np.float32)
    h = x.astype(float)
    for weight, bias in zip(mlp.weights[:-1], mlp.biases[:-1], strict=True):
        h = REFERENCE[activation](h @ weight.T + bias)
    expected = h @ mlp.weights[-1].T + mlp.biases[-1]
    size = np.abs(expected).max()
    assert np.abs(mlp(x) - expected).max() < ACCURATE * size
    artifact = random_artifact(inputs=False, noise=False, age=False)
    whiten, zeros = np.eye(3, artifact.filter.size), np.zeros(3)
    inverse = replace(
        artifact.inverse, mlp=mlp, whiten=whiten, noise_gain=zeros, x_offset=zeros[:2], x_scale=np.ones(2)
    )
    observer = KKLObserver(replace(artifact, inverse=inverse), compiled=True)
    found = [observer.reset(row) for row in x[:, :1].astype(float)]
    inputs = (x[:, :1] @ artifact.filter.equilibrium.T - inverse.z_offset)[:, :3]
    assert np.abs(found - mlp(inputs)).max() < ACCURATE * np.abs(found).max()
    assert np.array_equal(mlp(x.reshape(2, 150, 3)).reshape(300, 2), mlp(x))


@pytest.mark.parametrize("activation", sorted(REFERENCE))
def test_activations_to_the_last_digits(activation):
    x = np.concatenate([np.linspace(-30, 30, 20001), np.logspace(-30, 1, 2001), [0.0, np.nan]]).astype(np.float32)
    one = np.ones((1, 1), np.float32)
    h = MLP([one, one], [np.zeros(1), np.zeros(1)], activation)(x[:, None])[:, 0]
    assert np.isnan(h[-1])
    x, h = x[:-1], h[:-1]
    expected = REFERENCE[activation](x.astype(float))
    assert (np.abs(h - expected) <= 1e-6 * np.abs(x)).all()  # silu of -30 suffers cancellation, in NumPy too
    assert (np.abs(h - expected) <= 1e-6 * np.abs(expected))[x >= -1].all()
    if activation == "tanh":
        assert (np.abs(h - expected) <= 3e-7 * np.abs(expected)).all()
        assert np.abs(h).max() <= 1.0


NO_NUMBA = """
import pickle, sys
sys.modules["numba"] = None
import numpy as np
import observers
found = []
for observer, y, u in pickle.load(sys.stdin.buffer):
    found.append([observer.step(*each) for each in zip(y, u)])
try:
    observers.KKLObserver(observer.artifact, compiled=True)
except ImportError as error:
    found.append(str(error))
observer = observers.KKLObserver(observer.artifact)
observer.reset([0.0])
observer.step([0.0])
pickle.dump(found, sys.stdout.buffer)
"""


def test_pickled_compiled_observers_load_without_numba():
    there, expected = [], []
    for make, batch in itertools.product((EQUATIONS, FLOW, static), ((), (ROWS,))):
        artifact = make()
        y, u, _ = record(artifact, 60, batch)
        observer = KKLObserver(artifact, 0.1, compiled=True)
        observer.reset(y[0])
        for k in range(1, 30):
            observer.step(y[k], u[k])
        there.append(pickle.loads(pickle.dumps((observer, y[30:], u[30:]))))
        others = [copy.deepcopy(observer), copy.copy(observer), pickle.loads(pickle.dumps(observer))]
        expected.append([observer.step(y[k], u[k]) for k in range(30, 60)])
        for other in others:  # copies agree to the last bit where Numba is installed
            assert np.array_equal([other.step(y[k], u[k]) for k in range(30, 60)], expected[-1])
            np.testing.assert_array_equal(other.covariance, observer.covariance)
    command = [sys.executable, "-c", NO_NUMBA]
    done = subprocess.run(command, input=pickle.dumps(there), capture_output=True, check=True)
    *found, refused = pickle.loads(done.stdout)
    assert "pip install kkl-gym[fast]" in refused
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("batch", [(), (2000,)])
def test_threads_do_not_share_memory(batch):
    """Threads use trackers of one artifact, and estimate records by one observer."""
    artifact, shared, found = FLOW(), KKLObserver(static(), 0.1, compiled=True), {}
    y, u, _ = record(artifact, 40, batch)

    def work(i):
        observer = KKLObserver(artifact, 0.1 * (i + 1), compiled=True)
        observer.reset(y[0])
        steps = np.array([observer.step((1 + 0.1 * i) * y[k], u[k]) for k in range(1, 40)])
        found[i] = steps, shared.estimate((1 + 0.1 * i) * y, u)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i in range(4):
        before = found.pop(i)
        work(i)
        assert all(map(np.array_equal, before, found[i]))


@pytest.mark.parametrize(("batch", "compiled"), [((), False), ((), True), ((2,), False), ((ROWS,), True)])
def test_t_inv_replaces_a_covariance_that_is_not_positive_definite(batch, compiled):
    """With almost exact outputs, rounding makes some covariances indefinite."""
    artifact, tiny = FLOW(), np.full(2, 1e-9)
    changes = {"least_measurement_noise": np.full(1, 1e-13), "error": tiny, "process_noise": tiny}
    artifact = replace(artifact, motion=replace(artifact.motion, **changes))
    options = {"process_noise": 0.0, "compiled": compiled}
    observer, plain = (KKLObserver(artifact, 0.0, tracking=choice, **options) for choice in (True, False))
    x, taken = np.random.default_rng(0).normal(size=(*batch, 2)), 0
    for each in (observer, plain):
        each.reset(x @ artifact.C.T, x if each is observer else None)
    for _ in range(200):
        x = artifact.motion.step(x, np.zeros((*batch, 1)), 0.01)
        x_hat, of_t_inv = (each.step(x @ artifact.C.T) for each in (observer, plain))
        assert np.isfinite(x_hat).all()
        assert np.isfinite(observer.covariance).all()
        taken += np.isclose(x_hat, of_t_inv, rtol=1e-4).all(-1).any()
    assert taken


def test_nothing_compiles_after_the_first_steps():
    """Inputs may be read-only or strided, samples may be missing, rows may restart, and noise levels may change."""
    artifact = EQUATIONS()
    observer, other = (KKLObserver(artifact, 0.1, compiled=choice) for choice in (True, False))
    frozen, y = np.array([0.2]), np.array([0.1, 0.2])
    frozen.flags.writeable = False
    KKLObserver(artifact, 0.1).estimate(np.zeros((2, 2)))
    with numba.core.event.install_recorder("numba:compile") as recorder:
        for each in (observer, other):
            each.reset(y)
            for u in (np.broadcast_to(0.3, (1,)), frozen, np.zeros((3, 2))[:1, 1], np.float32([0.1]), [0], None):
                each.step(y, u)
            each.measurement_noise = (0.1, 0.3)
            for sample in (None, [np.nan, 0.3], [np.nan, np.nan], np.full((2, 2), 0.1)[:, 1], [0, 0]):
                each.advance(sample)
                each.advance(sample, rows=np.array(True))
                each.advance(sample, rows=np.broadcast_to(False, ()))
            each.restart([y], np.array(True))
            each.step(y + 1e6)
        np.testing.assert_allclose(observer.step(y), other.step(y), rtol=1e-4)
    assert not [event.data["dispatcher"].py_func.__qualname__ for _, event in recorder.buffer]


def test_long_expressions_stay_with_numpy_and_maps_may_have_no_hidden_layers():
    artifact, rng = tracking(), np.random.default_rng(0)
    long = Expression(
        [["+", *[["*", 0.0, ["x", 0]]] * 300, *(["*", c, ["x", i]] for i, c in enumerate(artifact.C[0]))]]
    )
    mlp = MLP([rng.normal(size=(2, artifact.inverse.mlp.inputs))], [rng.normal(size=2)], "tanh")
    shallow = replace(random_artifact(), inverse=replace(random_artifact().inverse, mlp=mlp))
    y, u, _ = record(artifact, 30)
    for one, other in ((artifact, replace(artifact, C=None, h=long)), (shallow, shallow)):
        one, other = KKLObserver(one, 0.1, compiled=False), KKLObserver(other, 0.1, compiled=True)
        found = [[each.reset(y[0]), *(each.step(*step) for step in zip(y[1:], u))] for each in (one, other)]
        np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-4)
