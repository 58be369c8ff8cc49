"""Samples with missing outputs: the observer substitutes its own prediction."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_system import TwoOutputs, exact_observer
from monitor_limits import limits

from kkl_gym.simulate import simulate
from observers import Expression, KKLObserver, Monitor

DT, STEPS = 0.05, 400
C, H = np.eye(2), Expression([["x", 0], ["x", 1]])


def exact(**changes):
    return dataclasses.replace(exact_observer(DT, C, TwoOutputs.name), **changes)


def motions(n=3):
    x0 = np.random.default_rng(0).uniform(-1, 1, (n, 2))
    return simulate(TwoOutputs(), x0, STEPS, DT)


def step_by_step(observer, y):
    return np.array([observer.reset(y[0]), *(observer.step(row) for row in y[1:])])


@pytest.mark.parametrize("output", [{"C": C}, {"C": None, "h": H}], ids=["C", "h"])
def test_outputs_at_different_rates(output):
    x = motions()
    y = TwoOutputs().output(x)
    slow = y.copy()
    slow[np.arange(STEPS + 1) % 5 != 0, :, 1] = math.nan  # the second sensor has a fifth of the rate
    held = slow.copy()
    for k in range(1, STEPS + 1):
        held[k] = np.where(np.isnan(slow[k]), held[k - 1], slow[k])

    def error(record, **changes):
        x_hat = KKLObserver(exact(**output, **changes)).estimate(record)
        return np.sqrt(np.mean((x_hat - x)[200:] ** 2))

    assert error(slow) < 0.01
    assert error(slow) < 0.05 * error(held)
    nothing = {"C": None, "h": None}
    assert np.array_equal(
        KKLObserver(exact(**nothing)).estimate(slow), KKLObserver(exact(**nothing)).estimate(held)
    )  # without h, the last value is held


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    batch=st.lists(st.integers(1, 3), max_size=2).map(tuple),
    share=st.sampled_from([0.1, 0.5, 0.9]),
    output=st.sampled_from(["C", "h", "nothing"]),
    seed=st.integers(0, 1000),
)
def test_records_agree_with_steps_and_batches_with_their_rows(batch, share, output, seed):
    artifact = exact(C=C if output == "C" else None, h=H if output == "h" else None)
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(12, *batch, 2))
    y[1:][rng.random((11, *batch, 2)) < share] = math.nan
    whole = y.copy()
    x_hat = KKLObserver(artifact).estimate(y)
    np.testing.assert_array_equal(y, whole)  # the caller's array is unchanged
    assert np.isfinite(x_hat).all()
    np.testing.assert_allclose(x_hat, step_by_step(KKLObserver(artifact), y), atol=1e-5)
    for row in np.ndindex(batch):
        alone = step_by_step(KKLObserver(artifact), y[(slice(None), *row)])
        np.testing.assert_allclose(x_hat[(slice(None), *row)], alone, atol=1e-5)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_sample_without_outputs_is_a_missing_sample(batch):
    y = np.random.default_rng(1).normal(size=(4, *batch, 2))
    one, other = (KKLObserver(exact()) for _ in range(2))
    for observer in (one, other):
        observer.reset(y[0])
        observer.step(y[1])
    assert np.array_equal(one.step(np.full((*batch, 2), math.nan)), other.step(None))
    assert np.array_equal(one.step(y[3]), other.step(y[3]))
    assert np.array_equal(one.z, other.z)


def test_invalid_samples_are_refused():
    observer, gap = KKLObserver(exact()), np.array([0.1, math.nan])
    for call in (observer.reset, lambda y: observer.estimate([y, [0.1, 0.2]])):
        with pytest.raises(ValueError, match="the first sample must be complete"):
            call(gap)
    observer.reset(np.zeros((2, 2)))
    observer.step(np.ones((2, 2)))
    z = observer.z
    with pytest.raises(ValueError, match="the first sample must be complete"):
        observer.restart(gap[None], np.array([True, False]))
    for wrong in ([math.inf, 0.0], [math.nan, -math.inf], [1e16, math.nan]):
        for call in (observer.reset, lambda y: observer.step([y, y]), lambda y: observer.estimate([[0.0, 0.0], y])):
            with pytest.raises(
                ValueError, match=r"y holds NaN, infinity or .* 1e15: y\[.*(nan|inf|1e\+16); (NaN marks|outputs)"
            ):
                call(wrong)
    assert np.array_equal(observer.z, z)


def test_predictions_that_are_nan_are_not_used():
    undefined = Expression([["sqrt", ["+", ["x", 0], -1e3]], ["x", 1]])
    observer, holding = KKLObserver(exact(C=None, h=undefined)), KKLObserver(exact(C=None))
    for each in (observer, holding):
        each.reset([0.5, 0.5])
        each.step([math.nan, 0.6])
    assert np.array_equal(observer.z, holding.z)
    assert np.isfinite(observer.step(None)).all()


def test_missing_outputs_do_not_change_the_score():
    """If one output of two is always missing, the score is that of a monitor of the other output."""
    artifact, y = exact(limits=limits(2)), TwoOutputs().output(motions(1)[:, 0])
    watched, first = KKLObserver(artifact, 0.0, monitor=True), Monitor(limits(2), 0.0, DT)
    watched.reset(y[0])
    rows = first.start(1)
    for k in range(1, 60):
        x_hat = watched.step([y[k, 0] + 0.2, math.nan])
        rows = first.update(rows, np.array([[y[k, 0] + 0.2 - x_hat[0], 0.0]]), np.array([[True, False]]))
        assert watched.score == pytest.approx(first.score(rows)[0])
    score = watched.score
    assert score > 0.3
    watched.step([math.nan, math.nan])
    watched.step(None)
    assert watched.score == score


def test_rows_of_monitored_batches_with_gaps_are_monitors_of_their_own():
    artifact = exact(limits=limits(2))
    rng = np.random.default_rng(3)
    y = rng.normal(size=(30, 3, 2))
    y[1:][rng.random((29, 3, 2)) < 0.3] = math.nan
    together = KKLObserver(artifact, 1.0, monitor=True)
    together.reset(y[0])
    alone = [KKLObserver(artifact, 1.0, monitor=True) for _ in range(3)]
    for i, observer in enumerate(alone):
        observer.reset(y[0, i])
    for k in range(1, 30):
        active = np.array([True, k % 2 == 0, True])
        together.advance(y[k], rows=active)
        for i in np.flatnonzero(active):
            alone[i].advance(y[k, i])
        if k == 12:
            together.restart(y[0, 2:], np.array([False, False, True]))
            alone[2].reset(y[0, 2])
        assert together.score == pytest.approx([float(observer.score) for observer in alone], rel=1e-5)
    assert (together.score > 0).all()
