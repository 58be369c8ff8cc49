import dataclasses
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from observers import KKLObserver, LinearFilter, load

KINDS = [{"inputs": inputs, "noise": noise, "age": age} for inputs in (0, 1) for noise in (0, 1) for age in (0, 1)] + [
    {"system": "lorenz", "pair": True},
    {"free_inverse": True},
    {"process": True},
]
CLOSE = {"rtol": 1e-5, "atol": 1e-4}  # rounding of the float32 network


def record(observer, steps, *batch, seed=0):
    rng = np.random.default_rng(seed)
    artifact = observer.artifact
    return rng.normal(size=(steps, *batch, artifact.ny)), rng.normal(size=(steps - 1, *batch, artifact.nu))


def step_by_step(observer, y, u):
    out = [observer.reset(y[0])]
    out += [observer.step(y[k + 1], u[k]) for k in range(len(u))]
    return np.array(out)


def begun(artifact, **options):
    """Two observers after the same two samples."""
    both = KKLObserver(artifact, **options), KKLObserver(artifact, **options)
    for observer in both:
        observer.reset([0.5])
        observer.step([0.7], [0.1] * artifact.nu)
    return both


@pytest.mark.parametrize("options", KINDS, ids=str)
def test_the_estimate_is_the_formula(options, make_artifact):
    """The operations that the observer merges, written out with plain arrays."""
    artifact = make_artifact(**options)
    inverse, observer = artifact.inverse, KKLObserver(artifact, 0.3, process_noise=0.1)
    y, u = record(observer, 5)
    x_hat = step_by_step(observer, y, u)[-1]
    modes = inverse.whiten @ (observer.z - inverse.z_offset) / (1 + (0.3 * inverse.noise_gain) ** 2)
    h = [*modes]
    if options.get("noise", True):
        h.append(math.log(1 + 0.3 / 0.1))
    if options.get("process"):
        h.append(math.log(1 + 0.1 / 0.01))
    if options.get("age", True):
        h.append(math.log(1 + 4 * 0.01 / 0.05))
    h = np.array(h)
    *hidden, (weight, bias) = zip(inverse.mlp.weights, inverse.mlp.biases, strict=True)
    for w, b in hidden:
        h = w @ h + b
        h = h / (1 + np.exp(-h))
    assert np.allclose(x_hat, inverse.x_offset + inverse.x_scale * (weight @ h + bias), **CLOSE)


@settings(deadline=None, max_examples=15, derandomize=True)
@given(
    batch=st.lists(st.integers(0, 4), max_size=3).map(tuple), options=st.sampled_from(KINDS), seed=st.integers(0, 1000)
)
def test_batches_equal_their_rows_and_records_their_steps(make_artifact, batch, options, seed):
    observer = KKLObserver(make_artifact(**options))
    y, u = record(observer, 6, *batch, seed=seed)
    x_hat, z = step_by_step(observer, y, u), observer.z
    assert x_hat.shape == (6, *batch, observer.artifact.nx)
    assert x_hat.dtype == z.dtype == np.float64
    assert z.shape == (*batch, observer.artifact.filter.size)
    assert np.allclose(observer.estimate(y, u), x_hat, **CLOSE)
    for index in np.ndindex(*batch):
        row = (slice(None), *index)
        assert np.allclose(x_hat[row], step_by_step(observer, y[row], u[row]), **CLOSE)
        assert np.allclose(z[index], observer.z, rtol=1e-12, atol=1e-13)


def test_estimate_keeps_the_observers_state_and_accepts_one_more_row_of_u_or_no_u(make_artifact):
    observer = KKLObserver(make_artifact())
    y, u = record(observer, 10)
    expected = observer.estimate(y, u)
    with pytest.raises(RuntimeError, match="reset"):
        _ = observer.z
    first = step_by_step(observer, y, u)
    z = observer.z
    observer.estimate(-y, u)
    assert np.array_equal(observer.z, z)
    assert np.array_equal(step_by_step(observer, y, u), first)  # a reset discards the past
    assert np.array_equal(observer.estimate(y, np.concatenate([u, [[99.0]]])), expected)
    assert np.array_equal(observer.estimate(y), observer.estimate(y, 0 * u))
    assert not np.allclose(observer.estimate(y), expected)
    assert observer.estimate(y[:1]).shape == (1, 2)


def test_until_an_input_acts_the_map_of_free_motion_is_in_use(make_artifact):
    both = make_artifact(free_inverse=True)
    linear = LinearFilter(both.filter.A, both.filter.B, both.filter.dt, 0)
    driven, free = (
        KKLObserver(dataclasses.replace(both, free_inverse=None)),
        KKLObserver(dataclasses.replace(make_artifact(inputs=False), filter=linear, inverse=both.free_inverse)),
    )
    observer, steps = KKLObserver(both), 12
    y, _ = record(observer, steps, 3)
    u = np.zeros((steps - 1, 3, 1))
    u[4, 1] = 1e-9  # from here on, one row is driven, if weakly
    u[7, 2] = -2.0
    begins = np.array([steps, 5, 8])
    x_hat, always, never = step_by_step(observer, y, u), driven.estimate(y, u), free.estimate(y)
    expected = np.where((np.arange(steps)[:, None] >= begins)[..., None], always, never)
    assert not np.allclose(always, never, atol=0.01)
    assert np.allclose(x_hat, expected, **CLOSE)
    assert np.allclose(observer.estimate(y, u), expected, **CLOSE)
    observer.restart(y[0, 1:2], np.array([False, True, False]))
    assert np.allclose(observer.decode()[1], free.estimate(y[:1])[0, 1], **CLOSE)
    alone = KKLObserver(both)
    for row in range(3):
        assert np.allclose(step_by_step(alone, y[:, row], u[:, row]), expected[:, row], **CLOSE)


def test_a_missing_sample_holds_the_last_if_the_output_map_is_unknown(make_artifact):
    coasting, holding = begun(make_artifact())
    for _ in range(3):
        assert np.array_equal(coasting.step(None, [0.1]), holding.step([0.7], [0.1]))
    assert np.array_equal(coasting.step([0.2]), holding.step([0.2], [0.0]))  # no input is zero input
    assert not np.array_equal(coasting.step([0.2]), holding.step([0.2], [1.0]))


def test_arrays_are_the_callers(make_artifact):
    safe, reused = KKLObserver(make_artifact()), KKLObserver(make_artifact())
    y, u = record(safe, 6)
    expected = step_by_step(safe, y, u)
    buffer = y[0].copy()
    got = [reused.reset(buffer).copy()]
    for k in range(5):
        buffer[:] = y[k + 1]
        x_hat = reused.step(buffer, u[k])
        got.append(x_hat.copy())
        x_hat[:] = 99.0
        reused.z[:] = 99.0
    assert np.array_equal(got, expected)


@pytest.mark.parametrize(
    "same", [[0.5], (0.5,), np.array([0.5], np.float32), np.array([0.5], ">f8"), np.ma.masked_array([0.5], [False]),
             np.array([0.5], np.longdouble)],
)  # fmt: skip
def test_every_kind_of_real_array_is_taken(same, make_artifact):
    observer, plain = KKLObserver(make_artifact()), KKLObserver(make_artifact())
    assert np.array_equal(observer.reset(same), plain.reset(np.array([0.5])))
    assert np.array_equal(observer.step(same, same), plain.step(np.array([0.5]), np.array([0.5])))
    assert type(observer.step(None)) is type(observer.z) is np.ndarray
    plain.step(None)
    assert np.array_equal(observer.step([1], np.uint8([1])), plain.step([1.0], [1.0]))


def test_a_map_without_inputs_refuses_them(make_artifact):
    observer, other = begun(make_artifact(inputs=False))
    with pytest.raises(ValueError, match=r"van_der_pol takes no inputs, but u = \[0\.5\]"):
        observer.step([1.0], np.array([0.5]))
    with pytest.raises(ValueError, match="takes no inputs"):
        observer.estimate(np.zeros((3, 1)), np.ones((2, 1)))
    with pytest.raises(ValueError, match="u must hold real numbers"):
        observer.step([1.0], ["a"])
    assert np.array_equal(observer.step([1.0], [0.0]), other.step([1.0]))


@pytest.mark.parametrize("level", [1, np.float32(0.5), np.int8(1), Fraction(1, 2)])
def test_every_kind_of_real_number_is_a_noise_level(level, make_artifact):
    observer = KKLObserver(make_artifact(process=True), level, process_noise=level)
    assert (observer.measurement_noise, observer.process_noise) == (float(level), float(level))
    assert type(observer.measurement_noise) is type(observer.process_noise) is float


@pytest.mark.parametrize("free", [False, True])
def test_process_noise_changes_the_estimate_up_to_the_level_in_training(make_artifact, free):
    artifact = make_artifact(process=True, free_inverse=free)
    estimates = [KKLObserver(artifact, process_noise=level).reset([1.0]) for level in (0.0, 0.1, 0.2, 5.0, None)]
    assert not np.allclose(estimates[0], estimates[1], atol=1e-6)
    assert not np.allclose(estimates[1], estimates[2], atol=1e-6)
    assert np.array_equal(estimates[2], estimates[3])
    assert np.array_equal(estimates[2], estimates[4])
    observer = KKLObserver(artifact)
    observer.process_noise = 0.1
    assert np.array_equal(estimates[1], observer.reset([1.0]))
    observer.process_noise = 0.0
    assert np.array_equal(estimates[0], observer.decode())
    observer.process_noise = None
    assert np.array_equal(estimates[2], observer.decode())
    plain = make_artifact()  # without this feature
    assert np.array_equal(KKLObserver(plain, process_noise=0.1).reset([1.0]), KKLObserver(plain).reset([1.0]))


def test_age_changes_the_estimate_until_age_max(make_artifact):
    observer = KKLObserver(make_artifact(age=True))
    x_hat = observer.estimate(np.full((400, 1), 0.3))  # the filter stays in equilibrium
    assert not np.allclose(x_hat[0], x_hat[1], rtol=1e-3)
    assert not np.allclose(x_hat[198], x_hat[200], rtol=1e-6, atol=0)
    assert np.allclose(x_hat[200:], x_hat[200], rtol=1e-6)


def test_load_passes_its_settings_on(saved, make_artifact):
    path = saved(process=True)
    observer, direct = load(path, 0.3, process_noise=0.1), KKLObserver(make_artifact(process=True), 0.3)
    assert (observer.measurement_noise, observer.process_noise) == (0.3, 0.1)
    direct.process_noise = 0.1
    y, u = record(direct, 5)
    assert np.array_equal(observer.estimate(y, u), direct.estimate(y, u))
    for call, first in ((load, path), (KKLObserver, make_artifact())):
        with pytest.raises(TypeError, match="positional"):
            call(first, 0.3, True)
