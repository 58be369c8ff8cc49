"""Limits found by simulation, and faults that exceed them."""

import dataclasses

import numpy as np
import pytest
from linear_system import Oscillator, TwoOutputs, exact_observer

from kkl_gym.elementary import sin
from observers import ArtifactError, Expression, KKLObserver
from training.teaching.monitor import PARTS, WARM_UP, calibrate, sound_trajectories


class Noiseless(Oscillator):
    """A linear observer of three fixed modes follows process noise slowly; that is not what is tested here."""

    name = "oscillator"
    process_noise = 0.0


@pytest.fixture(scope="module")
def calibrated():
    told = []
    yield calibrate(exact_observer(), Noiseless(), trajectories=600, duration=20.0, report=told.append)
    assert told == list(range(1, PARTS))


def ever_above(artifact, level, y):
    """Which runs of outputs, (steps, runs, ny), raise an alarm."""
    observer = KKLObserver(artifact, level, monitor=True)
    observer.reset(y[0])
    seen = np.zeros(y.shape[1], dtype=bool)
    for row in y[1:]:
        observer.advance(row)
        seen |= observer.score > 1
    return seen


def test_calibration_keeps_its_promise(calibrated):
    system, found = Noiseless(), calibrated.limits
    assert (np.diff(found.mean[1:, 0]) > 0).all()  # more noise, wider limits
    assert found.low[0] == 0.0
    assert found.low[-1] < found.levels[-1] == 1.0 < found.high[-1]  # about the variance of the noise
    rng = np.random.default_rng(11)
    x, _ = sound_trajectories(calibrated, system, n=600, duration=20.0, rng=rng)
    for level in (0.2, 1.0):
        y = system.output(x) + level * rng.standard_normal((*x.shape[:2], 1))
        alarms = ever_above(calibrated, level, y)
        assert alarms.mean() < 0.02  # promised 0.01; of 600 runs, 12 are more than chance allows


@pytest.mark.parametrize("fault", ["bias", "drop-out", "freeze"])
def test_faults_are_seen(fault, calibrated):
    system, rng, level, at = Noiseless(), np.random.default_rng(12), 0.1, 300
    x, _ = sound_trajectories(calibrated, system, n=50, duration=30.0, rng=rng)
    x = x[:, np.abs(x[0]).max(-1) > 0.5]
    y = system.output(x) + level * rng.standard_normal((*x.shape[:2], 1))
    assert not ever_above(calibrated, level, y[: round(WARM_UP / 0.05)]).any()
    y[at:] = {"bias": y[at:] + 0.4, "drop-out": 0.0 * y[at:], "freeze": np.broadcast_to(y[at], y[at:].shape)}[fault]
    assert ever_above(calibrated, level, y[: at + 126]).mean() >= 0.9  # within a period after the fault


def test_limits_reach_as_far_as_the_map_is_told():
    told = dataclasses.replace(exact_observer().inverse, measurement_noise_max=3.0)
    artifact = dataclasses.replace(exact_observer(), inverse=told)
    assert calibrate(artifact, Noiseless(), duration=6.0).limits.levels[-1] == 3.0


def test_runs_that_leave_are_drawn_anew():
    class Tight(Noiseless):
        name = "oscillator"
        bounds = ((-1.2, 1.2), (-1.2, 1.2))

    class Leaving(Noiseless):
        name = "oscillator"
        bounds = ((-1.0, 1.0), (-1.0, 1.0))

    rng = np.random.default_rng(0)
    x, u = sound_trajectories(exact_observer(), Tight(), n=50, duration=10.0, rng=rng)
    assert x.shape[1] == u.shape[1] == 50
    assert np.isfinite(x).all()

    Leaving.process_noise = 30.0
    with pytest.raises(ValueError, match="leave bounds"):
        sound_trajectories(exact_observer(), Leaving(), n=50, duration=10.0, rng=rng)


def test_impossible_calibrations():
    for wrong in ({"false_alarms": 0.0}, {"duration": 1.0}, {"trajectories": 599}, {"seed": -1}):
        with pytest.raises(ValueError, match=r"need|too few"):
            calibrate(exact_observer(), Oscillator(), **wrong)
    with pytest.raises(
        ValueError, match=r"observer of 'oscillator' cannot hold h\(x\), .*test_calibration\.py, .*kkl_gym\.elementary"
    ):
        calibrate(dataclasses.replace(exact_observer(), C=None), OnFloats())
    with pytest.raises(ArtifactError, match="system"):
        calibrate(exact_observer(), Steep())


class Steep(Oscillator):
    name = "steep"


class OnFloats(Oscillator):
    name = "oscillator"

    def h(self, x):
        return (np.sin(x[0]),)


class Sine(Noiseless):
    """An output that is not linear; the exact observer of a linear one serves it where y is small."""

    name = "oscillator"
    X = ((-0.2, 0.2), (-0.2, 0.2))

    def h(self, x):
        return (sin(x[0]),)


def test_limits_of_an_output_that_is_not_linear():
    artifact = dataclasses.replace(exact_observer(), C=None, measurement_noise=0.05)
    assert not artifact.knows_output
    calibrated = calibrate(artifact, Sine(), duration=20.0)  # which gives it the system's output
    assert calibrated.h == Expression([["sin", ["x", 0]]])
    rng = np.random.default_rng(13)
    x, _ = sound_trajectories(calibrated, Sine(), n=50, duration=20.0, rng=rng)
    y = Sine().output(x) + 0.05 * rng.standard_normal((*x.shape[:2], 1))
    y[:, 25:] += 0.3
    seen = ever_above(calibrated, None, y)  # at the usual level
    assert seen[:25].mean() <= 0.1
    assert seen[25:].mean() >= 0.9


def test_limits_of_outputs_with_levels_of_their_own():
    class Quiet(TwoOutputs):
        name = "two-outputs"
        process_noise = 0.0
        measurement_noise = (0.1, 1.0)

    artifact = exact_observer(C=np.eye(2), name=Quiet.name)
    calibrated = calibrate(dataclasses.replace(artifact, measurement_noise=(0.1, 1.0)), Quiet(), duration=20.0)
    limits = calibrated.limits
    np.testing.assert_allclose(limits.levels[-1], [0.2, 2.0])
    assert limits.levels.shape == limits.mean.shape == (6, 2)
    np.testing.assert_allclose(limits.levels[:, 1], 10 * limits.levels[:, 0])
    assert (limits.low[-1] < limits.levels[-1] ** 2).all()
    assert (limits.levels[-1] ** 2 < limits.high[-1]).all()
    rng = np.random.default_rng(14)
    x, _ = sound_trajectories(calibrated, Quiet(), n=200, duration=20.0, rng=rng)
    for levels in ((0.1, 1.0), (0.02, 1.0), (0.2, 0.1)):
        y = Quiet().output(x) + levels * rng.standard_normal((*x.shape[:2], 2))
        alarms = ever_above(calibrated, levels, y)
        assert alarms.mean() < 0.04  # promised 0.01; of 200 runs, 8 are more than chance allows
