"""Limits of an observer's residual in sound operation, for :class:`observers.Monitor`."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from kkl_gym.simulate import check_duration, simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver, Limits
from training.seeds import Stream, generator
from training.trajectories.controllers import Controller
from training.trajectories.expression import output_expression
from training.trajectories.noise import draw_process_noise, noisy_output
from training.trajectories.parameters import blind, with_parameters
from training.trajectories.policy import under_policy
from training.trajectories.signals import KINDS, random_inputs

LEVELS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of noise, in multiples of the largest that the map is told
LARGEST = 2.0  # for maps that are not told the noise, in multiples of the usual
WINDOW, WARM_UP = 0.5, 5.0  # seconds at the pace of the shipped systems
TRIES = 8
MARGIN = 1.05  # on limits found among finitely many trajectories
PARTS = 1 + len(LEVELS)  # of the work: simulating, and each level


def calibrate(
    artifact: Artifact,
    system: System,
    *,
    trajectories: int | None = None,
    duration: float | None = None,
    false_alarms: float = 0.01,
    seed: int = 0,
    policy: Controller | None = None,
    report: Callable[[int], object] = lambda done: None,
) -> Artifact:
    """Find limits for an observer's monitor.

    Sound trajectories are simulated from starts in X with the system's process noise, half of them under random inputs
    if the map knows inputs, at several noise levels. Where the observer was trained for a range of parameters, each has
    its own. Each limit is the one that a new trajectory exceeds with a sixth
    of the probability ``false_alarms`` (and of an output's share in it). A margin makes up for finding it among few.

    Parameters
    ----------
    artifact : Artifact
        An observer. If it holds no h(x), it is given the system's.
    system : System
        What it was made for.
    trajectories : int, optional
        Number of trajectories; by default as many as it takes to tell such rare events.
    duration : float, optional
        Length of each in seconds; by default the system's own.
    false_alarms : float
        Probability that a sound trajectory of this length exceeds a limit.
    seed : int
        Seed of starts, inputs and noise.
    policy : callable, optional
        Acts on the system, for maps that were trained under one; half of the trajectories then are its own, and in the
        others it explores.
    report : callable, optional
        Told how many of the ``PARTS`` of the work are done.

    Returns
    -------
    Artifact
        The same with limits.

    Raises
    ------
    ValueError
        If h(x) cannot be written down, a number makes no sense, or the trajectories are too few to tell such rare
        events; :class:`observers.ArtifactError` (a ValueError) if the observer was made for another system.
    """
    artifact.check(system.name, system.parameters, dt=artifact.filter.dt, ny=system.ny, nu=system.nu)
    if not artifact.knows_output:
        artifact = dataclasses.replace(artifact, h=output_expression(system))
    duration = system.duration if duration is None else duration
    window, warm_up = WINDOW * system.pace, WARM_UP * system.pace
    if not 0 < false_alarms < 1 or duration <= warm_up or seed < 0:
        raise ValueError(
            f"need 0 < false_alarms < 1, duration > {warm_up} and seed >= 0, got {false_alarms}, {duration}, {seed}"
        )
    share = false_alarms / (6 * system.ny)
    least = math.ceil(1 / share - 1e-9)
    if trajectories is not None and trajectories < least:
        raise ValueError(f"{trajectories} trajectories are too few for {false_alarms:g}: take {least}")
    rng = generator(Stream.CALIBRATION, seed)
    plant, policy = with_parameters(system, artifact.parameter_ranges), policy and blind(policy, system.nx)
    x, u = sound_trajectories(artifact, plant, n=trajectories or least, duration=duration, rng=rng, policy=policy)
    largest = np.asarray(artifact.inverse.measurement_noise_max)
    if not np.isfinite(largest).all():
        largest = LARGEST * np.asarray(artifact.measurement_noise)
    levels = np.multiply.outer(LEVELS, largest)
    rows = []
    for done, level in enumerate(levels, 1):
        report(done)
        rows.append(_limits(artifact, plant, x=x, u=u, level=level, share=share, rng=rng))
    mean, low, high = (np.array(each) for each in zip(*rows, strict=True))
    return dataclasses.replace(
        artifact, limits=Limits(levels, mean, low, high, window, warm_up, false_alarms, duration)
    )


def sound_trajectories(
    artifact: Artifact,
    system: System,
    *,
    n: int,
    duration: float,
    rng: np.random.Generator,
    policy: Controller | None = None,
    process_noise: float | None = None,
    kinds: tuple[str, ...] = KINDS,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate trajectories with process noise, every other one under random inputs if the map knows inputs.

    Those that leave the system's bounds are drawn anew. Returns ``x`` (steps + 1, n, nx) and ``u`` (steps, n, nu).
    """
    dt = artifact.filter.dt
    check_duration(duration, dt)
    steps, level = round(duration / dt), system.process_noise if process_noise is None else process_noise
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    while (missing := n - sum(x.shape[1] for x, _ in kept)) > 0:
        u = np.zeros((steps, missing, system.nu))
        if artifact.nu and not policy:
            u[:, ::2] = random_inputs(system, len(range(0, missing, 2)), steps, dt=dt, rng=rng, kinds=kinds)
        w = draw_process_noise(system, level, n=missing, steps=steps, rng=rng)
        x0 = system.draw_starts(rng, missing)
        if policy:
            own = np.arange(missing) % 2 == 1
            x, u = under_policy(system, policy, x0, steps=steps, dt=dt, rng=rng, own=own, w=w)
        else:
            x = simulate(system, x0, steps, dt, u=u, w=w)
        inside = np.isfinite(x[-1]).all(-1)
        kept.append((x[:, inside], u[:, inside]))
        if len(kept) == TRIES:
            raise ValueError(f"most trajectories of {duration:g} s leave bounds = {system.bounds}")
    xs, us = zip(*kept, strict=True)
    return np.concatenate(xs, 1), np.concatenate(us, 1)


def _limits(
    artifact: Artifact,
    system: System,
    *,
    x: np.ndarray,
    u: np.ndarray,
    level: np.ndarray,
    share: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Limits of mean, low and high at one noise level, of all outputs () or each (ny,); each of the limits (ny,)."""
    dt, levels = artifact.filter.dt, level.tolist()
    y = noisy_output(system, x, measurement_noise=levels, rng=rng)
    observer = KKLObserver(artifact, levels, process_noise=system.process_noise)
    residual = artifact.residual(y, observer.estimate(y, u if artifact.nu else None))
    a = -np.expm1(-dt / (WINDOW * system.pace))
    late = slice(round(WARM_UP * system.pace / dt) + 1, None)
    means = np.abs(lfilter([a], [1.0, a - 1.0], residual, axis=0))[late]
    squares = lfilter([a], [1.0, a - 1.0], residual**2, axis=0)[late]
    mean = np.quantile(means.max(0), 1 - share, axis=0, method="weibull") * MARGIN
    high = np.quantile(squares.max(0), 1 - share, axis=0, method="weibull") * MARGIN
    low = np.quantile(squares.min(0), share, axis=0, method="weibull") / MARGIN if level.any() else np.zeros_like(high)
    return mean, low, high
