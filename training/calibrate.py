"""Limits of an observer's residual in sound operation, for :class:`observers.Monitor`."""

import dataclasses
import math

import numpy as np
from scipy.signal import lfilter

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver, Limits
from training.data import output
from training.signals import random_inputs

CALIBRATION_SEED = 5  # first entry of its seeds; those of training and evaluation are others
LEVELS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of noise, in multiples of the largest
LARGEST = 1.0  # for maps that are not told the noise
WINDOW = 0.5  # s
WARM_UP = 5.0  # s
MARGIN = 1.05  # on limits found among finitely many runs


def calibrate(
    artifact: Artifact,
    system: System,
    trajectories: int | None = None,
    duration: float = 50.0,
    false_alarms: float = 0.01,
    seed: int = 0,
) -> Artifact:
    """The same artifact with limits for a monitor.

    Sound runs are simulated from starts in X with the system's process noise, half of them under random inputs if the
    map knows inputs, at several noise levels. Each limit is the one that a sixth of ``false_alarms`` (and of an
    output's share in it) of them exceed, so that all together are exceeded half as often as promised.

    Parameters
    ----------
    artifact : an observer of a linear output.
    system : what it was made for.
    trajectories : number of runs; None is as many as it takes to tell such rare events.
    duration : of each, in seconds.
    false_alarms : probability that a sound run of this length exceeds a limit.
    seed : of everything random.

    Raises
    ------
    ValueError : if the output is not linear, a number makes no sense, or the runs are too few to tell such rare events;
        :class:`observers.ArtifactError` (a ValueError) if the observer was made for another system.
    """
    artifact.check(system.name, system.parameters, artifact.filter.dt, system.ny, system.nu)
    if artifact.C is None:
        raise ValueError(f"the output of {system.name!r} is not linear: there is no C x_hat to compare it with")
    if not 0 < false_alarms < 1 or duration <= WARM_UP or seed < 0:
        raise ValueError(
            f"need 0 < false_alarms < 1, duration > {WARM_UP} and seed >= 0, got {false_alarms}, {duration}, {seed}"
        )
    share = false_alarms / (6 * system.ny)
    least = math.ceil(1 / share - 1e-9)
    if trajectories is not None and trajectories < least:
        raise ValueError(f"{trajectories} runs are too few for {false_alarms:g}: take {least}")
    rng = np.random.default_rng([CALIBRATION_SEED, seed])
    x, u = sound_runs(artifact, system, trajectories or least, duration, rng)
    levels = np.array(LEVELS) * min(artifact.inverse.noise_max, LARGEST)
    rows = [_limits(artifact, system, x, u, level, share, rng) for level in levels]
    mean, low, high = (np.array(each) for each in zip(*rows, strict=True))
    return dataclasses.replace(
        artifact, limits=Limits(levels, mean, low, high, WINDOW, WARM_UP, false_alarms, duration)
    )


def sound_runs(
    artifact: Artifact, system: System, n: int, duration: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """States (steps + 1, n, nx) and inputs (steps, n, nu) of runs that stay within the system's bounds."""
    dt = artifact.filter.dt
    steps = round(duration / dt)
    u = np.zeros((steps, n, system.nu))
    if artifact.nu:
        u[:, ::2] = random_inputs(system, len(range(0, n, 2)), steps, dt, rng)
    w = system.process_noise * np.array(system.scale) * rng.uniform(-1.0, 1.0, (steps, n, system.nx))
    x = simulate(system, rng.uniform(*system.box(), (n, system.nx)), steps, dt, u=u, w=w)
    inside = np.isfinite(x[-1]).all(-1)
    if 2 * inside.sum() < n:
        raise ValueError(f"only {inside.sum()} of {n} runs stayed within bounds = {system.bounds}")
    return x[:, inside], u[:, inside]


def _limits(
    artifact: Artifact,
    system: System,
    x: np.ndarray,
    u: np.ndarray,
    level: float,
    share: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Limits of mean, low and high at one noise level, each (ny,)."""
    dt = artifact.filter.dt
    y = output(system, x) + level * rng.standard_normal((*x.shape[:2], system.ny))
    residual = y - KKLObserver(artifact, level).estimate(y, u if artifact.nu else None) @ artifact.C.T  # type: ignore[union-attr]
    a = -np.expm1(-dt / WINDOW)
    late = slice(round(WARM_UP / dt) + 1, None)
    means = np.abs(lfilter([a], [1.0, a - 1.0], residual, axis=0))[late]
    squares = lfilter([a], [1.0, a - 1.0], residual**2, axis=0)[late]
    mean = np.quantile(means.max(0), 1 - share, axis=0) * MARGIN
    high = np.quantile(squares.max(0), 1 - share, axis=0) * MARGIN
    low = np.quantile(squares.min(0), share, axis=0) / MARGIN if level else np.zeros_like(high)
    return mean, low, high
