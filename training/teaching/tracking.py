"""Teaching an observer that is there already to track: a learned flow, and covariances that are calibrated."""

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from rich.console import Console

from kkl_gym.system import System
from observers import Artifact, Factors, Flow
from training.config import settings_of
from training.maps.ahead import draw_courses, learn_ahead
from training.maps.flow import Increments, draw_increments, fit_flow, possible_degrees, usual_bend, usual_error
from training.maps.regions import LEVELS, Errors, Regions, errors_along, level_of
from training.progress import ProgressBars, progress_bars
from training.seeds import Stream, generator
from training.teaching.monitor import PARTS, WINDOW, calibrate, sound_trajectories
from training.trajectories.controllers import Controller
from training.trajectories.expression import output_expression
from training.trajectories.signals import DRIVEN

LEAST_NOISE = 0.02  # the least measurement noise that is assumed, in multiples of what is usual for the map
LEAST_PROCESS_NOISE = 0.002  # the same of process noise, at the pace of the shipped systems
OF_OUTPUT = 1e-4  # of each output's standard deviation: less noise is not assumed, as covariances would be rounding
AHEAD = 0.125  # of the batches that learn single samples, so many learn many samples in a row
UNSURE = 1.5  # times what was added to covariances at each sample before: a flow that asks for more is not taken
REACH = 2.0  # of X, within which estimates may lie at least
JUDGED = 0.05  # share of the increments of which the flow's error is taken, and which it does not learn from


def learn_tracking(
    artifact: Artifact,
    system: System,
    *,
    steps: int = 40_000,
    small: bool = False,
    trajectories: int = 1600,
    seed: int = 0,
    policy: Controller | None = None,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Artifact:
    """Teach an observer to track: to carry its estimate on by the system's motion, which is learned here.

    T_inv and its error bars stay as they are. A polynomial and a small network learn how states change over a sample,
    on simulated ones about the system's motions. They then learn what many samples in a row add up to. An unscented
    Kalman filter on that flow is what :class:`observers.KKLObserver` then runs beside z. Its covariances are calibrated
    on further motions, so that regions of 90 % hold 90 % of the errors, or up to 91 % where a few are far off, and so
    are the limits of the monitor, if there are any.
    """
    artifact.check(system.name, system.parameters, dt=artifact.filter.dt, ny=system.ny, nu=system.nu)
    artifact.require_spread()
    if artifact.parameter_ranges:
        raise ValueError(
            f"an observer for a range of {', '.join(artifact.parameter_ranges)} cannot track: a flow is of one plant"
        )
    if steps < 1 or trajectories < 50 or seed < 0:
        raise ValueError(
            f"need a step at least, 50 trajectories and a seed that is not negative, got {steps}, {trajectories}, "
            f"{seed}"
        )
    artifact = dataclasses.replace(artifact, flow=None)
    if not artifact.knows_output:
        artifact = dataclasses.replace(artifact, h=output_expression(system))
    duration, largest = settings_of(artifact.training).duration, artifact.process_noise_max
    regions = Regions.of(artifact, duration, pace=system.pace)
    levels = (0.0,) if largest is None else (0.0, largest)
    torch.manual_seed(seed)
    with progress_bars(console) as progress:
        flow = _learned(
            artifact,
            system,
            duration=duration,
            steps=steps,
            small=small,
            seed=seed,
            policy=policy,
            progress=progress,
            device=device,
        )
        ones = np.ones((*(() if len(levels) == 1 else (2,)), *regions.tables))
        flow = dataclasses.replace(flow, factors=Factors(np.array(LEVELS), regions.knots * artifact.filter.dt, ones))
        tracking = dataclasses.replace(artifact, flow=flow)
        tables = []
        with progress.phase("calibrating the error bars", len(levels) * (1 + len(LEVELS))) as report:
            for table, level in enumerate(levels):
                runs = sound_trajectories(
                    artifact,
                    system,
                    n=trajectories,
                    duration=duration,
                    rng=generator(Stream.CALIBRATION, seed, 6 + table),
                    policy=policy,
                    process_noise=level,
                    kinds=DRIVEN,
                )
                begun = table * (1 + len(LEVELS)) + 1
                report(begun)
                rng = generator(Stream.CALIBRATION, seed, 8 + table)
                reported = partial(_tell, report, begun)
                tables.append(_factors(tracking, system, runs, level, regions=regions, rng=rng, report=reported))
        driven, free = ([table[i] for table in tables] for i in range(2))
        flow = dataclasses.replace(
            flow,
            factors=_with_tables(flow.factors, driven),
            free_factors=_with_tables(flow.factors, free) if artifact.nu else None,
        )
        tracking = dataclasses.replace(tracking, flow=flow)
        if tracking.limits is not None:
            with progress.phase("finding the monitor's limits", PARTS) as report:
                tracking = calibrate(tracking, system, policy=policy, report=report)
    return tracking


def _with_tables(factors: Factors, tables: list[tuple[np.ndarray, np.ndarray]]) -> Factors:
    """With factors and doubts for each level of process noise, or the only one."""
    found, doubts = (np.array(each) if len(tables) > 1 else each[0] for each in zip(*tables, strict=True))
    return dataclasses.replace(factors, factors=found, doubt=doubts)


def _tell(report: Callable[[float], object], begun: int, done: int) -> None:
    """Tell how much of the work is done: some, and what has been since."""
    report(begun + done)


def _learned(
    artifact: Artifact,
    system: System,
    *,
    duration: float,
    steps: int,
    small: bool,
    seed: int,
    policy: Controller | None,
    progress: ProgressBars,
    device: torch.device | None,
) -> Flow:
    """The flow, with factors that are none yet."""
    dt, nu = artifact.filter.dt, artifact.nu
    rng = generator(Stream.CALIBRATION, seed, 5)
    with progress.phase("simulating motions"):
        drawn = draw_increments(system, dt, duration=duration, nu=nu, rng=rng, policy=policy)
    held_out = round(JUDGED * len(drawn.x))
    judged, increments = drawn.part(slice(held_out)), drawn.part(slice(held_out, None))
    u_scale = np.array(system.u_max[:nu], dtype=float)
    low, high = (np.array(bound, dtype=float) for bound in zip(*system.bounds, strict=True))
    degrees = possible_degrees(artifact.nx + nu)
    usual = np.broadcast_to(np.asarray(artifact.measurement_noise, dtype=float), (system.ny,))
    outputs = np.nanstd(system.output(increments.x), axis=0)
    least = np.maximum(LEAST_NOISE * usual, OF_OUTPUT * outputs)
    flow = fit_flow(
        increments,
        u_scale,
        degrees=degrees,
        steps=steps,
        small=small,
        seed=seed,
        progress=progress,
        device=device,
        low=low,
        high=high,
        process_noise=np.array(system.scale) / increments.x_scale * dt / np.sqrt(3),
        least_process_noise=LEAST_PROCESS_NOISE / system.pace,
        least_measurement_noise=np.where(least > 0, least, 1.0),
        window=WINDOW * system.pace,
    )
    flow = _judged(flow, judged)
    if ahead := round(AHEAD * steps):
        with progress.phase("simulating courses"):
            courses = draw_courses(system, increments.x, increments.u, dt, samples=round(duration / dt))
        other = learn_ahead(flow, courses, steps=ahead, seed=seed, progress=progress, device=device)
        other = _judged(other, judged)
        less_sure = other.variances(0.0, 0.0)[0] > UNSURE**2 * flow.variances(0.0, 0.0)[0]
        flow = flow if less_sure.any() else other
    return _bounded(flow, drawn.x, system) if flow.degree > degrees[0] else flow


def _bounded(flow: Flow, x: np.ndarray, system: System) -> Flow:
    """A flow that is asked no further than 2X and the states (n, nx) that it was fitted to.

    Beyond them a polynomial of a high degree grows steeply, and a covariance with it: after a few false samples an
    estimate would stay lost.
    """
    low, high = system.box(REACH)
    low, high = np.minimum(low, x.min(0)), np.maximum(high, x.max(0))
    return dataclasses.replace(flow, low=np.maximum(flow.low, low), high=np.minimum(flow.high, high))


def _judged(flow: Flow, increments: Increments) -> Flow:
    """A flow that says what it is off by."""
    return dataclasses.replace(flow, error=usual_error(flow, increments), bend=usual_bend(flow, increments))


def _factors(
    artifact: Artifact,
    system: System,
    runs: tuple[np.ndarray, np.ndarray],
    process_noise: float,
    *,
    regions: Regions,
    rng: np.random.Generator,
    report: Callable[[int], object],
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Factors and doubts (levels, knots) of an observer that tracks, along runs of a level of process noise.

    Those of motions on which an input has acted, and of others; the same where the observer knows of no inputs, or
    inputs act on all motions.
    """
    x, u = runs
    clean, errors = system.output(x), list[Errors]()
    for done, share in enumerate(LEVELS, 1):
        level = level_of(artifact, share)
        y = clean + np.asarray(level) * rng.standard_normal(clean.shape)
        errors.append(errors_along(artifact, x, y, u, level=level, process_noise=process_noise, ages=regions.ages))
        report(done)
    acted = np.maximum.accumulate((u != 0).any(-1), axis=0)
    driven = np.concatenate([np.zeros_like(acted[:1]), acted])[regions.ages]
    if not artifact.nu or driven[-1].all():  # under a policy no motion stays free, and later ages would have no factors
        return (regions.factors_and_doubts(errors, np.ones_like(driven)),) * 2
    return regions.factors_and_doubts(errors, driven), regions.factors_and_doubts(errors, ~driven)
