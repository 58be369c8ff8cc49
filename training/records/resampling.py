"""From samples at any times to uniform grids, on which filters run."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from training.records.record import Record

LONGEST_GAP = 3.0  # steps between samples across which is interpolated
ROUNDING = 1e-6  # of a step, by which times may be off


def median_step(*records: Record) -> float:
    """Median of the steps of time in seconds, of one record or several."""
    return float(np.median(np.concatenate([np.diff(record.t) for record in records])))


def sampling_interval(*records: Record) -> float:
    """The median step in seconds, of no more digits than the times agree on, two at least."""
    uneven = max(map(jitter, records))
    digits = 12 if uneven < 1e-12 else int(np.clip(-np.log10(uneven), 2, 12))
    return float(f"{median_step(*records):.{digits}g}")


def jitter(record: Record) -> float:
    """How uneven the steps are: their largest deviation from the median step over it, gaps of samples aside."""
    steps = np.diff(record.t) / median_step(record)
    return float(np.max(abs(steps - np.maximum(steps.round(), 1.0))))


def resampled(record: Record, dt: float | None = None) -> Record:
    """Put a record on a uniform grid that begins with its first sample.

    Outputs are linear between samples, as the filter takes them for: the value at a time of the grid is there one
    sample later at most. States, which no observer sees, follow a monotone cubic (PCHIP). Both are NaN between samples
    of their own column that are more than 3 dt apart. An input is the mean over each interval of the grid of what was
    held. On a record that has this grid nothing but rounding changes.
    """
    dt = median_step(record) if dt is None else dt
    if not 0 < dt <= record.duration * (1 + ROUNDING):
        raise ValueError(f"{record.name}: dt = {dt:g} s must be positive, and no more than its {record.duration:g} s")
    steps = int(np.floor(record.duration / dt + ROUNDING))
    t = np.minimum(record.t[0] + dt * np.arange(steps + 1), record.t[-1])
    signals, columns = record.signals, [] if record.x is None else list(record.x.T)
    y = [_interpolated(record, name, values, t, smooth=False) for name, values in zip(signals.measured, record.y.T)]
    x = [_interpolated(record, name, values, t, smooth=True) for name, values in zip(signals.hidden, columns)]
    return replace(record, t=t, y=np.stack(y, -1), u=_held(record, t, dt), x=np.stack(x, -1) if x else None)


def _interpolated(record: Record, name: str, values: np.ndarray, t: np.ndarray, *, smooth: bool) -> np.ndarray:
    """A column at the times t of a grid; NaN in gaps."""
    there = ~np.isnan(values)
    at, values, dt = record.t[there], values[there], t[1] - t[0]
    close = np.zeros(len(t), dtype=bool)
    if len(at) > 1:
        after = np.clip(np.searchsorted(at, t - ROUNDING * dt), 1, len(at) - 1)
        inside = (t >= at[0]) & (t <= at[-1]) & (at[after] - at[after - 1] <= LONGEST_GAP * dt * (1 + ROUNDING))
        close = inside | (np.minimum(abs(t - at[after - 1]), abs(t - at[after])) <= ROUNDING * dt)
    if close.sum() < 2 or not (smooth or (close[1:] & close[:-1]).any()):  # a filter takes one sample after the other
        raise ValueError(
            f"{record.name}: column {name}: no samples are less than {LONGEST_GAP:g} dt = {LONGEST_GAP * dt:.3g} s "
            "apart; take a larger dt"
        )
    return np.where(close, PchipInterpolator(at, values)(t) if smooth else np.interp(t, at, values), np.nan)


def _held(record: Record, t: np.ndarray, dt: float) -> np.ndarray | None:
    """Means of held inputs over the intervals that begin at t; the last input holds on."""
    if record.u is None:
        return None
    ends = np.append(record.t, max(record.t[-1], t[-1]) + 2 * dt)
    total = np.concatenate([np.zeros((1, record.u.shape[1])), np.cumsum(np.diff(ends)[:, None] * record.u, 0)])
    means = [(np.interp(t + dt, ends, column) - np.interp(t, ends, column)) / dt for column in total.T]
    return np.stack(means, -1)


def pieces(records: Iterable[Record]) -> list[Record]:
    """Split records where a row lacks an output: no filter runs across a gap."""
    found = []
    for record in records:
        whole = ~np.isnan(record.y).any(-1)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(int)))
        for begin, end in zip(edges[::2], edges[1::2]):
            if end - begin > 1:
                found.append(record.part(slice(int(begin), int(end))))
    return found
