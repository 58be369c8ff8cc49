"""Teaching observers from recorded states to track: a flow from one sample to the next, learned from records too."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from rich.console import Console

from observers import Artifact, Factors
from training.maps.flow import PAIRS, Increments, fit_flow, usual_error
from training.maps.regions import LEVELS
from training.progress import ProgressBars, progress_bars
from training.recorded.calibrating import parted, regions_of, stretches, told_apart
from training.recorded.config import signal_rate
from training.records import Record, pieces
from training.seeds import Stream, generator

BEYOND = 0.5  # of the states' range, by which estimates may leave it
OF_OUTPUT = 0.1  # of an output's standard deviation: what C x may leave of it
ROUNDING = 1e-6  # the same, below which an entry of C is none
# What is assumed at least: of the flow's error in standard deviations of the states, and of measurement noise in those
# of the outputs. A filter that trusts its model wholly stops listening.
LEAST_ERROR, LEAST_NOISE = 1e-3, 1e-4
WINDOW = 10  # samples at least over which innovations are averaged


def learn_recorded_tracking(
    artifact: Artifact,
    records: Sequence[Record],
    held_out: Sequence[Record] | None = None,
    *,
    steps: int = 10_000,
    seed: int = 0,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Artifact:
    """Teach an observer from recorded states to track: to carry its estimate on by a motion that is learned here.

    T_inv and its error bars stay as they are. A small network learns how the states change from one recorded sample to
    the next. What it is usually off by on the records that were held out counts as noise of the motion. The rest is as
    :func:`training.evaluation.tracking.learn_tracking` has it.

    A tracker compares each sample with what it expects. So the measured signals have to be among the hidden ones, or
    be sums of them.

    Parameters
    ----------
    artifact : Artifact
        The observer, with error bars. A flow that it has is replaced.
    records : sequence of Record
        With states: those of its training.
    held_out : sequence of Record, optional
        Others, on the observer's grid; ``records`` are then trained on, and on that grid too. By default the records
        are parted as in the training.
    steps : int
        Batches for the network.
    seed : int
        Of everything random.
    device : torch.device, optional
        Where the network is trained; by default on the CPU.
    console : Console or ProgressBars, optional
        Where progress is shown; by default nowhere.

    Returns
    -------
    Artifact
        The same with a flow.

    Raises
    ------
    ValueError
        If the observer was not learned from recorded states or has no error bars, a measured signal is no sum of hidden
        ones, the records are of other signals or without states, nothing was held out, or too little to calibrate on.
    """
    artifact = dataclasses.replace(artifact, flow=None, C=None, h=None)
    artifact.require_spread()
    train, others = parted(artifact, records, held_out)
    rng = generator(Stream.CALIBRATION, seed, 11)
    torch.manual_seed(seed)
    C, least_measurement_noise = linear_output(train)
    with progress_bars(console) as progress:
        learned, judged = (increments_of(artifact, part, rng) for part in (train, others))
        low, high = learned.x.min(0), learned.x.max(0)
        margin = np.where(high > low, BEYOND * (high - low), 1.0)
        u_scale = np.abs(learned.u).max(0)
        rate = signal_rate(train)
        flow = fit_flow(
            learned,
            np.where(u_scale > 0, u_scale, 1.0),
            steps=steps,
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
        flow = dataclasses.replace(flow, error=np.maximum(usual_error(flow, judged), LEAST_ERROR), factors=ones)
        tracking = dataclasses.replace(artifact, C=C, flow=flow)
        with progress.phase("calibrating the error bars") as report:
            factors = told_apart(tracking, runs, regions, rng=rng, lenient=True, report=report)
    return dataclasses.replace(
        tracking, flow=dataclasses.replace(flow, factors=dataclasses.replace(ones, factors=factors))
    )


def increments_of(artifact: Artifact, records: Sequence[Record], rng: np.random.Generator) -> Increments:
    """How states change from each recorded sample to the next.

    Parameters
    ----------
    artifact : Artifact
        An observer for the records.
    records : sequence of Record
        On its grid.
    rng : numpy.random.Generator
        Draws some where there are too many.

    Returns
    -------
    Increments
        Those between two samples of which both are known.

    Raises
    ------
    ValueError
        If there is none.
    """
    found = list[tuple[np.ndarray, ...]]()
    for record in pieces(records):
        if record.x is not None:
            u = record.u[:-1] if artifact.nu and record.u is not None else np.zeros((len(record.t) - 1, 0))
            found.append((record.x[:-1], u, np.diff(record.x, axis=0)))
    x, u, change = (np.concatenate(each) for each in zip(*found)) if found else (np.zeros((0, 1)),) * 3
    known = np.flatnonzero(np.isfinite(x + change).all(-1))
    if not len(known):
        raise ValueError("no two samples in a row have all hidden signals; record more")
    if len(known) > PAIRS:
        known = rng.choice(known, PAIRS, replace=False)
    x, u, change = x[known], u[known], change[known]
    scale = x.std(0)
    return Increments(x, u, change, x.mean(0), np.where(scale > 0, scale, 1.0))


def linear_output(records: Sequence[Record]) -> tuple[np.ndarray, np.ndarray]:
    """Find C with y = C x.

    Parameters
    ----------
    records : sequence of Record
        With states.

    Returns
    -------
    C : ndarray, shape (ny, nx)
        Entries that are rounding are 0.
    left : ndarray, shape (ny,)
        What is assumed of the noise of outputs at least: the root mean square of y - C x, which is noise of the
        records, or a ten-thousandth of the output's standard deviation.

    Raises
    ------
    ValueError
        If more is left of an output than noise would be.
    """
    y, x = (np.concatenate([getattr(record, name) for record in records if record.x is not None]) for name in "yx")
    known = np.isfinite(np.column_stack([x, y])).all(-1)
    x, y = x[known], y[known]
    size, scale = np.sqrt(np.mean(x**2, 0)), np.sqrt(np.mean(y**2, 0))
    size, scale = np.where(size > 0, size, 1.0), np.where(scale > 0, scale, 1.0)
    C = np.linalg.lstsq(x / size, y / scale, rcond=1e-9)[0].T
    C = np.where(np.abs(C) > ROUNDING, C, 0.0) * scale[:, None] / size
    left, moves, signals = np.sqrt(np.mean((y - x @ C.T) ** 2, 0)), y.std(0), records[0].signals
    if other := [name for name, rest, of in zip(signals.measured, left, moves) if rest > OF_OUTPUT * of]:
        raise ValueError(
            f"{', '.join(other)} cannot be told from {', '.join(signals.hidden)}, and an observer that tracks compares "
            "its samples with that: train one that estimates what is measured too, with it among the hidden signals"
        )
    return C, np.maximum(left, LEAST_NOISE * moves)


__all__ = ["increments_of", "learn_recorded_tracking", "linear_output"]
