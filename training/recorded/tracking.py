"""Teaching observers from recorded states to track: a flow from one sample to the next, learned from records too."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from rich.console import Console

from observers import Artifact, Factors
from observers.checks import integer
from training.maps.flow import OF_MEDIAN, PAIRS, Increments, fit_flow, usual_error
from training.maps.regions import LEVELS
from training.progress import ProgressBars, progress_bars
from training.recorded.calibrating import factors_and_doubts_along, parted, regions_of, stretches
from training.recorded.config import RecordedConfig, config_of, signal_rate
from training.records import Record, pieces
from training.seeds import Stream, generator

BEYOND = 0.5  # of the states' range, by which estimates may leave it
# What C x leaves of an output is noise, unless it is nearly all, or squares of states explain a part of it.
UNTOLD, SQUARES = 0.7, 0.8  # of the output's standard deviation, and of what is left
LITTLE = 0.1  # of that standard deviation: less is taken for noise in any case
ROUNDING = 1e-6  # of an output's size: below it an entry of C, or what is left, is rounding
OUTLIER = 6.0  # standard deviations of what is left, by its median
# What is assumed at least: of the flow's error in parts of what states change by over a sample, and of measurement
# noise in standard deviations of the outputs. A filter that trusts its model wholly stops listening.
LEAST_ERROR, LEAST_NOISE = 0.01, 1e-4
# Of the flow's polynomial. Of recorded states some lie alone, where higher powers are anything; and a motion that jumps
# now and then, as at a contact, is no polynomial's.
DEGREE = 1
WINDOW = 10  # samples at least over which innovations are averaged


def learn_recorded_tracking(
    artifact: Artifact,
    records: Sequence[Record],
    held_out: Sequence[Record] | None = None,
    *,
    steps: int = 40_000,
    small: bool = False,
    seed: int = 0,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Artifact:
    """Teach an observer from recorded states to track: to carry its estimate on by a motion that is learned here.

    T_inv and its error bars stay as they are. A small network, beside a linear fit, learns how the states change from
    one recorded sample to the next. What it is usually off by on the records that were held out counts as noise of the
    motion. The rest is as :func:`training.teaching.tracking.learn_tracking` has it.

    A tracker compares each sample with what it expects. So the measured signals have to be among the hidden ones, or
    be sums of them; an artifact that says so already, by its C, is taken at its word.
    """
    integer("steps", steps, 1)
    integer("seed", seed, 0)
    artifact = dataclasses.replace(artifact, flow=None)
    artifact.require_spread()
    train, others = parted(artifact, records, held_out)
    check_trackable(config_of(artifact))
    rng = generator(Stream.CALIBRATION, seed, 11)
    torch.manual_seed(seed)
    C, least_measurement_noise = linear_output(train, artifact.C)
    with progress_bars(console) as progress:
        learned, judged = (increments_of(artifact, part, rng) for part in (train, others))
        low, high = learned.x.min(0), learned.x.max(0)
        margin = np.where(high > low, BEYOND * (high - low), 1.0)
        u_scale = np.abs(learned.u).max(0)
        rate = signal_rate(train)
        flow = fit_flow(
            learned,
            np.where(u_scale > 0, u_scale, 1.0),
            degrees=(DEGREE,),
            steps=steps,
            small=small,
            seed=seed,
            progress=progress,
            device=device,
            low=low - margin,
            high=high + margin,
            process_noise=np.zeros(artifact.nx),  # it has no scale here; the flow's error stands for all noise
            least_process_noise=1.0,
            least_measurement_noise=least_measurement_noise,
            window=max(WINDOW * artifact.filter.dt, 0.5 / rate),
        )
        runs = stretches(artifact, others)
        regions = regions_of(artifact, runs, rate)
        ones = Factors(np.array(LEVELS), regions.knots * artifact.filter.dt, np.ones(regions.tables))
        least = LEAST_ERROR * np.sqrt(np.mean((learned.change / learned.x_scale) ** 2, axis=0))
        flow = dataclasses.replace(flow, error=np.maximum(usual_error(flow, judged), least), factors=ones)
        tracking = dataclasses.replace(artifact, C=C, flow=flow)
        with progress.phase("calibrating the error bars") as report:
            factors, doubt = factors_and_doubts_along(tracking, runs, regions, rng=rng, report=report)
    found = dataclasses.replace(ones, factors=factors, doubt=doubt)
    return dataclasses.replace(tracking, flow=dataclasses.replace(flow, factors=found))


def increments_of(artifact: Artifact, records: Sequence[Record], rng: np.random.Generator) -> Increments:
    """How states change from each recorded sample to the next."""
    found = list[tuple[np.ndarray, ...]]()
    for record in pieces(records):
        if record.x is not None:
            u = record.u[:-1] if artifact.nu and record.u is not None else np.zeros((len(record.t) - 1, 0))
            found.append((record.x[:-1], u, np.diff(record.x, axis=0)))
    x, u, change = (np.concatenate(each) for each in zip(*found)) if found else (np.zeros((0, 1)),) * 3
    known = np.flatnonzero(np.isfinite(x + change).all(-1))
    if not len(known):
        raise ValueError(
            "no two samples in a row have all hidden signals: record these at each sample, or train with a larger dt"
        )
    if len(known) > PAIRS:
        known = rng.choice(known, PAIRS, replace=False)
    x, u, change = x[known], u[known], change[known]
    scale = x.std(0)
    return Increments(x, u, change, x.mean(0), np.where(scale > 0, scale, 1.0))


def check_trackable(config: RecordedConfig) -> None:
    """See that an observer that is learned so can be taught to track."""
    if config.arbitrary_zero:
        raise ValueError(
            f"an observer that tracks compares {', '.join(config.arbitrary_zero)} with what it expects, and cannot do "
            "without its zero: learn one without arbitrary_zero"
        )


def linear_output(records: Sequence[Record], known: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find C with y = C x. Shapes: ``known`` (ny, nx); returns ``C`` (ny, nx), ``left`` (ny,)."""
    y, x = (np.concatenate([getattr(record, name) for record in records if record.x is not None]) for name in "yx")
    both = np.isfinite(np.column_stack([x, y])).all(-1)
    if not both.any():
        raise ValueError("no sample has all measured and all hidden signals; record them together")
    x, y = x[both], y[both]
    scale = np.sqrt(np.mean(y**2, 0))
    C, left = _fitted(x, y, scale) if known is None else (known, _usual(y - x @ known.T))
    moves = y.std(0)
    least = np.maximum(left, LEAST_NOISE * np.where(moves > ROUNDING * scale, moves, np.where(scale > 0, scale, 1.0)))
    if known is None:
        i, j = np.triu_indices(x.shape[1])
        _, unexplained = _fitted(np.column_stack([x, x[:, i] * x[:, j], np.ones(len(x))]), y, scale)
        much = left > np.maximum(LITTLE * moves, ROUNDING * scale)
        wrong = much & ((left > UNTOLD * moves) | (unexplained < SQUARES * left))
        signals = records[0].signals
        if other := [name for name, bad in zip(signals.measured, wrong) if bad]:
            raise ValueError(
                f"{', '.join(other)} cannot be told as a sum of {', '.join(signals.hidden)} without an offset, and an "
                "observer that tracks compares its samples with that: train one with what is measured, in the same "
                "units, among the hidden signals"
            )
    return C, least


def _fitted(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C of a fit that leaves outliers out, and what is usually left, (ny,)."""
    size = np.sqrt(np.mean(x**2, 0))
    size, scale = np.where(size > 0, size, 1.0), np.where(scale > 0, scale, 1.0)
    kept = np.ones(len(x), dtype=bool)
    for _ in range(4):
        C = np.linalg.lstsq(x[kept] / size, y[kept] / scale, rcond=1e-9)[0].T
        C = np.where(np.abs(C) > ROUNDING, C, 0.0) * scale[:, None] / size
        apart = y - x @ C.T
        usual = _usual(apart)
        kept = (np.abs(apart) <= np.maximum(OUTLIER * usual, ROUNDING * scale)).all(-1)
    return C, usual


def _usual(apart: np.ndarray) -> np.ndarray:
    """Standard deviations of noise (n, ny), from medians: outliers do not count."""
    return np.asarray(OF_MEDIAN * np.median(np.abs(apart), axis=0))


__all__ = ["check_trackable", "increments_of", "learn_recorded_tracking", "linear_output"]
