"""Outliers, irregular sampling times, and delayed samples."""

import copy
import warnings

import gymnasium as gym
import numpy as np
import pytest
from random_artifacts import random_artifact
from random_tracking import signals, tracking

import kkl_gym
from kkl_gym.simulate import simulate
from observers import KKLObserver, LinearFilter, load

EXACT = {"rtol": 1e-9, "atol": 1e-9}


def motions(name, steps, n=4, dt=0.01):
    """States and noisy outputs, (steps + 1, n, .)."""
    system, rng = kkl_gym.get_system(name), np.random.default_rng(0)
    x = simulate(system, rng.uniform(*system.box(), (n, system.nx)), steps, dt)
    return x, system.output(x) + 0.5 * rng.standard_normal((steps + 1, n, 1))


@pytest.mark.parametrize("name", sorted(kkl_gym.SYSTEMS))
def test_a_sample_that_is_far_off_hardly_moves_an_estimate_with_a_gate(name):
    x, y = motions(name, 300)
    far = y.copy()
    far[150] += 50.0  # 100 standard deviations of the noise
    observer, scale = load(name, 0.5, gate=5.0), x.std((0, 1))
    moved = np.abs(observer.estimate(far) - observer.estimate(y)) / scale
    assert moved.max() < 0.15
    plain = load(name, 0.5)
    assert (np.abs(plain.estimate(far) - plain.estimate(y)) / scale).max() > 1.0


def test_the_gate_accepts_a_jump_that_stays():
    x, y = motions("lorenz", 1200)
    x[600:], y[600:] = np.roll(x, 1, axis=1)[600:], np.roll(y, 1, axis=1)[600:]
    observer = load("lorenz", 0.5, gate=5.0)
    apart = np.abs(observer.estimate(y) - x) / x.std((0, 1))
    assert apart[800:].max() < 0.2
    observer.reset(y[0])
    for sample in y[1:]:
        observer.step(sample)
    assert (observer.rejected > 10).any()
    assert (observer.rejected < 200).all()


@pytest.mark.parametrize("compiled", [None, False])
def test_one_of_two_outputs_that_jumps_for_good_is_accepted_after_a_window(compiled):
    artifact = tracking(outputs=2, surer=-9.0)
    y, u = signals(artifact, 200)
    y[100:, 1] += 40.0
    observer, window = KKLObserver(artifact, 0.1, gate=8.0, compiled=compiled), round(artifact.motion.window / 0.01)
    observer.reset(y[0])
    for k in range(1, 200):
        observer.step(y[k], u[k - 1])
        if 100 <= k < 100 + window:
            assert observer.rejected == k - 99
    assert observer.rejected < 2 * window


def test_an_input_far_beyond_training_warns_once():
    observer = load("lorenz")
    observer.reset([0.0])
    observer.step([0.0], [20.0])
    with pytest.warns(UserWarning, match="an input of 1000 is far beyond those in training, at most 10") as warned:
        observer.step([0.0], [1000.0]), observer.estimate(np.zeros((3, 1)), np.full((2, 1), -1e3))
    assert len(warned) == 1


@pytest.mark.parametrize("nonlinear", [False, True])
def test_outputs_are_rejected_one_by_one_in_numpy_and_numba(nonlinear):
    artifact = tracking(outputs=2, nonlinear=nonlinear, surer=-9.0)
    y, u = signals(artifact, 200, (3,))
    gone = y.copy()
    y[60:180:20, 1, 0] += 40.0
    gone[60:180:20, 1, 0] = np.nan
    found = []
    for compiled in (None, False):
        observer = KKLObserver(artifact, 0.1, gate=8.0, compiled=compiled)
        observer.reset(y[0])
        steps = [np.append(observer.step(y[k], u[k - 1]), observer.rejected) for k in range(1, 200)]
        found.append((np.array(steps)[:, :6], observer.covariance, observer.rejected))
        assert observer.rejected.tolist() == [0, 6, 0]
        np.testing.assert_allclose(observer.covariance, KKLObserver(artifact, 0.1).estimate_covariance(gone, u)[-1])
    for ours, reference in zip(*found, strict=True):
        np.testing.assert_allclose(ours, reference, **EXACT)
    observer.restart(y[0, :1], np.array([False, True, False]))
    assert observer.rejected.tolist() == [0, 0, 0]


def test_filters_at_other_intervals_are_those_made_for_them():
    A, B = np.array([[-1.0, 5.0, 0.0], [-5.0, -1.0, 0.5], [0.0, 0.0, -3.0]]), np.ones((3, 2))
    other, made = LinearFilter(A, B, 0.1, 1).at(0.37), LinearFilter(A, B, 0.37, 1)
    assert other.dt == 0.37
    for name in ("transition", "drive", "equilibrium"):
        np.testing.assert_allclose(getattr(other, name), getattr(made, name), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("tracking", [None, False])
def test_irregular_sampling_times(tracking):
    """Irregular sampling times hardly increase the error if the observer gets them."""
    rng, dt = np.random.default_rng(1), 0.001
    x, y = motions("lorenz", 6000, n=20, dt=dt)
    regular = np.arange(0, 6000, 10)
    t = np.sort(regular + np.round(3 * rng.standard_normal(600)).astype(int))
    t = np.maximum.accumulate(np.where(np.diff(t, prepend=-1) > 0, t, t + 1)) - t[0]
    t = np.unique(t)[:590]
    observer, errors = load("lorenz", 0.5, tracking=tracking), []
    for at, times in ((regular[:590], None), (t, t * dt), (t, None)):
        off = observer.estimate(y[at], t=times) - x[at]
        errors.append(np.sqrt(np.mean((off[100:] / x.std((0, 1))) ** 2)))
    assert errors[1] < 1.2 * errors[0]
    assert errors[2] > 1.2 * errors[0]


def test_steps_and_records_at_other_intervals_agree_in_numpy_and_numba():
    artifact = tracking(surer=-9.0)
    y, u = signals(artifact, 60, (3,))
    dts = artifact.filter.dt * np.random.default_rng(0).uniform(0.3, 3.5, 59)
    y[7, 1] = np.nan
    t, found = np.concatenate([[0.0], np.cumsum(dts)]), []
    for compiled in (None, False):
        observer = KKLObserver(artifact, 0.1, compiled=compiled)
        steps = [observer.reset(y[0]), *(observer.step(y[k], u[k - 1], dt=dts[k - 1]) for k in range(1, 60))]
        np.testing.assert_allclose(observer.estimate(y, u, t=t), steps, **EXACT)
        found.append(steps)
    np.testing.assert_allclose(*found, **EXACT)
    usual = KKLObserver(artifact, 0.1)
    np.testing.assert_array_equal(usual.estimate(y, u, t=0.01 * np.arange(60)).shape, (60, 3, 2))


@pytest.mark.parametrize("by", ["flow", "discrete"])
def test_flows_and_discrete_motions_need_whole_sampling_intervals(by):
    artifact = tracking(by)
    observer, dt = KKLObserver(artifact, 0.1), artifact.filter.dt
    observer.reset(np.zeros(1))
    with pytest.raises(ValueError, match=r"predicts over whole sampling intervals, got a dt of 1\.5 intervals"):
        observer.step([0.1], dt=1.5 * dt)
    u, twice = np.array([0.2]), copy.copy(observer)
    expected = artifact.motion.step(artifact.motion.step(observer.decode(), u, dt), u, dt)
    found = artifact.motion.step(observer.decode(), u, dt, 2.0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    y, t = np.linspace(0.0, 0.3, 9)[:, None], dt * np.arange(9)
    rounded = observer.estimate(y, t=1.7e9 + t)  # seconds since 1970 have a resolution of 2e-7 s
    np.testing.assert_allclose(rounded, observer.estimate(y, t=t), atol=1e-4)
    slow = KKLObserver(artifact, 0.1, compiled=False)
    slow.reset(np.zeros(1))
    np.testing.assert_allclose(twice.step([0.1], u, dt=2 * dt), slow.step([0.1], u, dt=2 * dt), rtol=1e-4)


@pytest.mark.parametrize("compiled", [None, False])
def test_estimates_from_delayed_samples_are_predicted_to_the_present(compiled):
    artifact, late = tracking(forward=True), 3
    y, u = signals(artifact, 40, (2,))
    observer, then = (KKLObserver(artifact, 0.1, compiled=compiled, delay=d) for d in (late, 0))
    observer.reset(y[0])
    then.reset(y[0])
    for k in range(1, 40):
        arrives = k - late
        if arrives > 0:
            then.step(y[arrives], u[arrives - 1])
        ahead = copy.copy(then)
        for j in range(max(arrives, 0), k):
            expected = ahead.step(None, u[j])
        found = observer.step(y[max(arrives, 0)], u[k - 1])
        np.testing.assert_allclose(found, expected, **EXACT)
        np.testing.assert_allclose(observer.covariance, ahead.covariance, **EXACT)
        np.testing.assert_allclose(observer.z, then.z, **EXACT)
        np.testing.assert_allclose(observer.mismatch, then.mismatch, **EXACT)
    rows = np.array([False, True])
    before = observer.decode()
    observer.restart(y[0, :1], rows)
    observer.advance(y[0], u[0], rows=rows)
    np.testing.assert_array_equal(observer.decode()[0], before[0])
    fresh = KKLObserver(artifact, 0.1, compiled=compiled, delay=late)
    fresh.reset(y[0, :1])
    np.testing.assert_allclose(observer.decode()[1:], fresh.step(y[0, 1:], u[0, 1:]), **EXACT)


def test_late_samples_are_applied_to_a_copied_observer():
    artifact = tracking()
    y, u = signals(artifact, 30)
    observer, whole = KKLObserver(artifact, 0.1), KKLObserver(artifact, 0.1).estimate(y, u)
    observer.reset(y[0])
    for k in range(1, 20):
        if k == 15:
            snapshot = copy.copy(observer)
        observer.step(y[k] if k < 15 else None, u[k - 1])
    for k in range(15, 30):  # the late samples have arrived
        x_hat = snapshot.step(y[k], u[k - 1])
    np.testing.assert_array_equal(x_hat, whole[-1])


def test_wrappers_have_the_gate_and_the_delay_of_their_observers():
    env = kkl_gym.KKLObservation(gym.make("KKLLorenz-v0", measurement_noise=0.5))
    env.observer.gate, env.observer.delay = 5.0, 2
    _, info = env.reset(seed=0)
    assert info["rejected"] == 0
    envs = kkl_gym.KKLVectorObservation(gym.make_vec("KKLLorenz-v0", num_envs=3))
    envs.observer.gate = 5.0
    assert envs.reset(seed=0)[1]["rejected"].tolist() == [0, 0, 0]
    of_z = kkl_gym.KKLObservation(gym.make("KKLLorenz-v0"), estimate="z")
    with pytest.raises(ValueError, match="leave out tracking=False, or a wrapper's estimate='z'"):
        of_z.observer.gate = 5.0


def test_the_first_gap_that_no_map_fills_warns_once():
    observer = KKLObserver(random_artifact())
    observer.reset(np.zeros(1))
    with pytest.warns(UserWarning, match="a missing output keeps its last value") as warned:
        observer.estimate([[0.0], [0.1]]), observer.step(None), observer.step(None)
    assert len(warned) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        KKLObserver(tracking(), 0.1).estimate([[0.0], [np.nan]])


def test_errors_of_gates_and_delays():
    artifact = tracking()
    for options in ({"gate": 5.0}, {"delay": 2}):
        with pytest.raises(ValueError, match="cannot track"):
            KKLObserver(random_artifact(), **options)
        with pytest.raises(ValueError, match="leave out tracking=False, or"):
            KKLObserver(artifact, tracking=False, **options)
    observer, late = KKLObserver(artifact), KKLObserver(artifact, delay=2)
    for each in (observer, late):
        each.reset([0.0])
    with pytest.raises(RuntimeError, match="made with a gate"):
        _ = observer.rejected
    with pytest.raises(ValueError, match="leave dt out"):
        late.step([0.0], dt=0.02)
    with pytest.raises(ValueError, match="a record needs an observer without a delay"):
        late.estimate([[0.0], [0.1]])
