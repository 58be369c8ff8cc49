"""Machine code against NumPy, which is the reference. Estimates are compared in units of the map's scales."""

import copy
import itertools
import pickle
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from error_bars import with_error_bars
from exported_steps import apart_at_all_levels

import observers
from kkl_gym import get_system
from observers import compiled as machine
from observers import compiled_covariance
from observers.artifact import Artifact
from observers.names import resolve
from observers.thresholds import MANY_ROWS, SOON

pytest.importorskip("numba")

NAMES = sorted(set(observers.shipped().values()))
ARTIFACTS = {name: Artifact.read(resolve(name)) for name in NAMES}
BY_T_INV = [name for name, artifact in ARTIFACTS.items() if artifact.inverse.spread and artifact.flow is None]
ACCURATE = 1e-5
REFERENCE = {
    "tanh": np.tanh,
    "silu": lambda h: h / 2 * (1 + np.tanh(h / 2)),
    "relu": lambda h: np.maximum(h, 0.0),
}


def forget():
    """Forgets what has been compiled."""
    for cache in (machine.network_kernels, machine._decode, machine.batch_kernels):
        cache.cache_clear()
    for cache in (machine.active_kernel, machine.entering_kernel):
        cache.cache_clear()
    for cache in (observers.sparse._kernel, observers.sparse._single_kernel, compiled_covariance._covary):
        cache.cache_clear()


@pytest.fixture
def without_numba(monkeypatch):
    forget()
    monkeypatch.setitem(sys.modules, "numba", None)


def signals(artifact, steps, batch=(), seed=0):
    """Outputs as large as the system's, with a slow and a fast part, and inputs that begin after a while."""
    rng = np.random.default_rng(seed)
    size = np.array(get_system(artifact.system).output_range)
    t = 0.01 * np.arange(steps).reshape(-1, *(1 for _ in batch), 1)
    y = 0.4 * size * np.sin(t * rng.uniform(1, 4, (*batch, artifact.ny)) + rng.uniform(0, 6, (*batch, artifact.ny)))
    u = rng.uniform(-1, 1, (steps, *batch, artifact.nu))
    u[: steps // 3] = 0.0
    return y + 0.05 * size * rng.standard_normal(y.shape), u


def along(observer, y, u):
    return np.array([observer.reset(y[0]), *(observer.step(y[k], u[k]) for k in range(1, len(y)))])


def apart(found, expected, artifact):
    """Largest difference in units of the states' scales."""
    return np.abs((found - expected) / artifact.inverse.x_scale).max()


def along_z(observer, y, u):
    """Filter states."""
    observer.reset(y[0])
    found = [observer.z]
    for k in range(1, len(y)):
        observer.step(y[k], u[k])
        found.append(observer.z)
    return np.array(found)


@pytest.mark.parametrize("name", BY_T_INV)
def test_compiled_error_bars_of_single_samples_are_numpys(name):
    """Free and driven motion, at levels of noise and ages between those of the factors, at them and beyond."""
    artifact = Artifact.read(resolve(name))
    y, u = signals(artifact, 60)
    for level, process_noise in ((0.0, 0.0), (0.37, 0.4), (1.0, 5.0)):
        options = {"process_noise": process_noise}
        one, other = (observers.KKLObserver(artifact, level, compiled=choice, **options) for choice in (True, False))
        for z in along_z(other, y, u)[[0, 19, 59]]:
            ages = artifact.inverse.spread.ages
            for age in (*ages, *(ages[1:] + ages[:-1]) / 2, 1e3, np.inf):
                found, expected = (observer._states.covariances(z, float(age)) for observer in (one, other))
                size = np.sqrt(expected.diagonal())
                assert 0 < np.abs((found - expected) / np.outer(size, size)).max() < 1e-4  # not the same arithmetic
                np.testing.assert_array_equal(found, found.T)


@pytest.mark.parametrize("name", BY_T_INV)
def test_estimates_whose_error_bars_are_asked_for_at_each_sample(name):
    """NumPy makes both in one go from the second on. Levels of noise change meanwhile, and inputs begin."""
    one, other = (observers.load(name, compiled=choice) for choice in (True, False))
    y, u = signals(one.artifact, 60)
    plain = along(observers.load(name, compiled=False), y[:40], u)
    for k in range(60):
        found = []
        for observer in (one, other):
            if k == 40:
                observer.measurement_noise, observer.process_noise = 0.2, 0.3
            if k == 50:
                observer.replace(observer.artifact)
            x_hat = observer.step(y[k], u[k]) if k else observer.reset(y[k])
            found.append((x_hat, observer.covariance, observer.std))
        (x_hat, covariance, std), expected = found
        assert apart(x_hat, expected[0], one.artifact) < ACCURATE
        assert np.abs((covariance - expected[1]) / np.outer(std, std)).max() < 1e-4
        np.testing.assert_allclose(std, np.sqrt(covariance.diagonal()), rtol=1e-12)
        if k < 40:
            assert apart(expected[0], plain[k], one.artifact) < ACCURATE


@pytest.mark.parametrize("name", BY_T_INV)
def test_error_bars_of_batches_are_those_of_single_samples(name):
    """Free motion, both, and driven motion alone; at ages that differ and in some rows."""
    artifact = Artifact.read(resolve(name))
    y, u = signals(artifact, 6, (2 * MANY_ROWS + 3,))
    u[1:3, ::2] = 0.0
    rows = np.arange(y.shape[1]) < MANY_ROWS
    observer = observers.KKLObserver(artifact, 0.3)
    single = observers.KKLObserver(artifact, 0.3, compiled=False)._states
    observer.reset(y[0])
    for k in range(1, 6):
        observer.step(y[k], u[k])
        if k == 4:
            observer.restart(y[4][::5], np.arange(y.shape[1]) % 5 == 0)
        found, part = observer.covariance, observer.decode_covariance(rows)
        z, ages = observer._moment(np.ones(y.shape[1], dtype=bool))
        for row in range(0, y.shape[1], 23):
            expected = single.covariances(z[row], float(ages[row]))
            size = np.sqrt(expected.diagonal())
            assert np.abs((found[row] - expected) / np.outer(size, size)).max() < 1e-4
            if rows[row]:
                assert np.abs((part[row] - expected) / np.outer(size, size)).max() < 1e-4


def test_error_bars_are_compiled_with_the_observer_and_stay_when_it_travels():
    compiled_covariance._covary.cache_clear()
    observer = observers.load("van_der_pol", compiled=True)
    y, u = signals(observer.artifact, 3)
    along(observer, y, u)
    kernel = compiled_covariance._covary(observer.artifact.inverse.spread.mlp.activation)
    assert len(kernel.signatures) == 1
    before = observer.covariance
    observer.step(y[1], np.array([0.3]))
    assert len(kernel.signatures) == 1  # for free and driven motion, and at any age
    assert not np.array_equal(observer.covariance, before)
    travelled = pickle.loads(pickle.dumps(observer))
    np.testing.assert_array_equal(travelled.covariance, observer.covariance)
    assert b"CompiledCovariance" not in pickle.dumps(observer)


@pytest.mark.parametrize("name", NAMES)
def test_single_samples_of_every_shipped_map(name):
    one, other = (observers.load(name, compiled=choice) for choice in (True, False))
    y, u = signals(one.artifact, 400)
    expected = along(other, y, u)
    assert expected.dtype == float
    # These signals are of no motion, so that a flow carries roundings on until the estimate is lost.
    assert apart(along(one, y, u), expected, one.artifact) < (ACCURATE if one.artifact.flow is None else 2e-4)
    assert np.allclose(one.z, other.z, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["van_der_pol-static", "lorenz-spinn"])
def test_ten_thousand_samples(name):
    one, other = (observers.load(name, compiled=choice) for choice in (True, False))
    y, u = signals(one.artifact, 10_001)
    assert apart(along(one, y, u), along(other, y, u), one.artifact) < ACCURATE


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_100_000_samples_of_every_shipped_map(name):
    def compiled(exported, y, u):
        levels = {"measurement_noise": exported.measurement_noise, "process_noise": exported.process_noise}
        observer = observers.KKLObserver(exported.artifact, **levels, compiled=True)
        return np.array([observer.reset(y[0]), *(observer.step(y[k], u[k - 1]) for k in range(1, len(y)))])

    of_range, of_scale = apart_at_all_levels(name, "float", compiled)
    print(f"{name}: {of_range:.1e} of the range, {of_scale:.1e} of the scale")
    assert of_range < 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_batches_of_every_shipped_map(name):
    """Of an odd number of rows, of which some have had no input yet; row by row is NumPy."""
    artifact = Artifact.read(resolve(name))
    y, u = signals(artifact, 4, (2 * MANY_ROWS + 3,))
    u[:, ::2] = 0.0
    found = along(observers.KKLObserver(artifact, 0.3), y, u)
    for row in range(0, y.shape[1], 37):
        single = observers.KKLObserver(artifact, 0.3, compiled=False)
        limit = ACCURATE if artifact.flow is None else 10 * ACCURATE  # what tracks adds up the rounding of each step
        assert apart(found[:, row], along(single, y[:, row], u[:, row]), artifact) < limit


def test_whatever_may_happen_to_a_batch(without_numba, monkeypatch):
    """Missing samples, rows that wait, restarts, records and error bars."""
    artifact = with_error_bars(Artifact.read(resolve("rossler")))
    n, rng = MANY_ROWS + 7, np.random.default_rng(1)
    y, u = signals(artifact, 40, (n,))
    masks = rng.random((40, n)) < 0.7

    def run():
        observer, found = observers.KKLObserver(artifact), []
        observer.reset(y[0])
        for k in range(1, 40):
            if k % 9 == 4:
                observer.step(None, u[k])
            elif k % 9 == 7:
                observer.restart(y[k][masks[k]], masks[k])
            else:
                observer.advance(y[k], u[k], masks[k] if k % 2 else None)
            found.append([observer.decode(), np.zeros((n, 3))])
            found[-1][1][masks[k]] = observer.decode(masks[k])
        return np.array(found), observer.covariance, observer.estimate(y, u[1:])

    expected = run()
    monkeypatch.undo()
    for found, other in zip(run(), expected, strict=True):
        assert np.abs(found - other).max() < ACCURATE * np.abs(other).max()


def test_single_samples_with_gaps_known_starts_and_error_bars():
    artifact = with_error_bars(Artifact.read(resolve("lorenz-spinn")))
    y, _ = signals(artifact, 60)
    x0, found = np.array([1.0, 2.0, 25.0]), []
    for choice in (True, False):
        observer = observers.KKLObserver(artifact, compiled=choice)
        steps = [observer.reset(y[0], x0)]
        for k in range(1, 60):
            steps.append(observer.step(None if k % 7 == 3 else y[k]))
            steps.append(observer.std)
        found.append(np.array(steps))
    assert apart(*found, artifact) < ACCURATE


@pytest.mark.parametrize("activation", sorted(REFERENCE))
@pytest.mark.parametrize("width", [5, 16])
def test_networks(activation, width):
    """Of a width that no loop likes too, far into where the activation is flat."""
    rng = np.random.default_rng(0)
    sizes = [3, width, width + 1, 2]
    mlp = observers.MLP(
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
    assert np.abs(mlp.compiled.batch(x) - expected).max() < ACCURATE * size
    assert np.abs([mlp.compiled.single(row) for row in x] - expected).max() < ACCURATE * size
    assert np.array_equal(mlp(x), mlp.compiled.batch(x))
    assert np.array_equal(mlp(x.reshape(2, 150, 3)).reshape(300, 2), mlp.compiled.batch(x))


@pytest.mark.parametrize("activation", sorted(REFERENCE))
def test_activations_to_the_last_digits(activation):
    x = np.concatenate([np.linspace(-30, 30, 20001), np.logspace(-30, 1, 2001), [0.0]]).astype(np.float32)
    h = x.copy()
    machine.network_kernels(activation).activate(h, np.zeros(7, np.float32))
    expected = REFERENCE[activation](x.astype(float))
    assert (np.abs(h - expected) <= 1e-6 * np.abs(x)).all()  # silu of -30 is a difference, in NumPy as well
    assert (np.abs(h - expected) <= 1e-6 * np.abs(expected))[x >= -1].all()
    if activation == "tanh":
        assert (np.abs(h - expected) <= 3e-7 * np.abs(expected)).all()
        assert np.abs(h).max() <= 1.0
    lost = np.array([np.nan], np.float32)
    machine.network_kernels(activation).activate(lost, np.zeros(1, np.float32))
    assert np.isnan(lost).all()


def test_a_network_without_hidden_layers_is_numpys():
    artifact = Artifact.read(resolve("lorenz-spinn"))
    rng = np.random.default_rng(0)
    mlp = observers.MLP([rng.normal(size=(3, artifact.inverse.mlp.inputs))], [rng.normal(size=3)], "tanh")
    artifact = replace(artifact, inverse=replace(artifact.inverse, mlp=mlp))
    y, u = signals(artifact, 5)
    one, other = (observers.KKLObserver(artifact, compiled=choice) for choice in (True, False))
    assert np.allclose(along(one, y, u), along(other, y, u), rtol=1e-12)


def is_compiled(observer):
    return observer._compiled


def test_a_long_simulation_is_compiled_at_a_reset_and_not_before():
    observer = observers.load("lorenz")
    y, u = signals(observer.artifact, SOON)
    along(observer, y, u)  # one step less than it takes
    observer.reset(y[0])
    assert not is_compiled(observer)
    for _ in range(SOON):
        observer.step(y[1])
    assert not is_compiled(observer)
    before = observer.z
    observer.reset(y[0])
    assert is_compiled(observer)
    assert before.shape == observer.z.shape
    observer.measurement_noise = 0.1  # new maps, compiled as well
    observer.replace(observer.artifact)
    assert is_compiled(observer)
    assert (
        apart(along(observer, y[:20], u), along(observers.load("lorenz", 0.1), y[:20], u), observer.artifact) < ACCURATE
    )


def test_batches_do_not_count_and_false_is_never():
    batched, never = observers.load("lorenz"), observers.load("lorenz", compiled=False)
    batched.reset(np.zeros((2, 1)))
    never.reset(np.zeros(1))
    for _ in range(SOON):
        batched.step(np.zeros((2, 1)))
        never.step(np.zeros(1))
    batched.reset(np.zeros(1))
    never.reset(np.zeros(1))
    assert not is_compiled(batched)
    assert not is_compiled(never)


def test_without_numba_long_simulations_go_on_in_numpy(without_numba):
    observer = observers.load("lorenz")
    observer.reset(np.zeros(1))
    for _ in range(SOON):
        observer.step(np.zeros(1))
    observer.reset(np.zeros(1))
    assert not is_compiled(observer)
    with pytest.raises(ImportError, match=r"kkl-gym\[fast\]"):
        observers.load("lorenz", compiled=True)


@pytest.mark.parametrize("wrong", ["yes", 1, np.array([True])])
def test_compiled_is_a_bool(wrong):
    with pytest.raises(ValueError, match="compiled must be True or False"):
        observers.load("lorenz", compiled=wrong)


def test_a_compiled_observer_goes_where_numba_is_not(monkeypatch):
    observer = observers.load("lorenz", compiled=True)
    y, u = signals(observer.artifact, 30)
    along(observer, y[:10], u)
    packed, twin = pickle.dumps(observer), copy.deepcopy(observer)
    expected = np.array([observer.step(y[k], u[k]) for k in range(10, 30)])
    assert np.array_equal(expected, [twin.step(y[k], u[k]) for k in range(10, 30)])
    forget()
    monkeypatch.setitem(sys.modules, "numba", None)
    there = pickle.loads(packed)
    assert apart(np.array([there.step(y[k], u[k]) for k in range(10, 30)]), expected, observer.artifact) < ACCURATE


def test_threads_do_not_share_memory():
    observer = observers.load("lorenz")
    n, found = 2000, {}
    y = np.linspace(-20, 20, n)[:, None]
    observer.reset(y)
    inputs = {i: observer.z * (1 + 0.1 * i) for i in range(4)}

    def work(i):
        found[i] = [observer._states(inputs[i], 1.0) for _ in range(20)]

    threads = [threading.Thread(target=work, args=(i,)) for i in inputs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i, z in inputs.items():
        expected = observer._states(z, 1.0)
        assert all(np.array_equal(x_hat, expected) for x_hat in found[i])


def test_inputs_that_are_read_only_or_have_strides():
    """To Numba they are of other types, but a run goes on and compiles nothing in its midst."""
    one, other = (observers.load("van_der_pol", compiled=choice) for choice in (True, False))
    held = np.broadcast_to(0.3, (1,))
    frozen = np.array([0.2])
    frozen.flags.writeable = False
    for observer in (one, other):
        observer.reset([0.5])
        observer.step([0.4], [0.1])
    made = len(observers.sparse._single_kernel().signatures)
    for u in (held, frozen, np.zeros((3, 2))[:1, 1], np.float32([0.1]), [0]):
        assert apart(one.step([0.4], u), other.step([0.4], u), one.artifact) < ACCURATE
    assert len(observers.sparse._single_kernel().signatures) == made


def test_a_batch_compiles_nothing_more_where_rows_restart():
    observer = observers.load("van_der_pol")
    y = np.linspace(-1, 1, MANY_ROWS)[:, None]
    enter = machine.batch_kernels(observer.artifact.inverse.mlp.activation).enter
    observer.reset(y)
    observer.step(y, y)
    made = len(enter.signatures)
    observer.restart(y[:3], np.arange(MANY_ROWS) < 3)
    observer.step(y, y)
    observer.estimate(np.zeros((MANY_ROWS, 1)))
    assert len(enter.signatures) == made
