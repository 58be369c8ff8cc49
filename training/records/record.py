"""A record: samples of a plant's outputs, and of its inputs and states if they were recorded."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from observers import LinearFilter
from observers.checks import real_array

ROLES = {"y": "measured", "u": "inputs", "x": "hidden"}  # field of Record: field of Signals that names its columns
MAX_SAMPLE = 1e100  # largest absolute value of a valid sample, so that sums of squares stay finite
LONGEST_GAP = 3.0  # longest gap, in steps of the grid, in which samples are interpolated
ROUNDING = 1e-6  # tolerance of times, in steps of the grid
MOST_STEPS = 1000  # largest mean number of grid steps between samples; a record with more has a jump in its times


@dataclass(frozen=True)
class Signals:
    """The names of a record's columns by role; an empty role stands for the usual names, such as y1, y2.

    A signal other than the time is the name of a column, or ``cos(column)`` or ``sin(column)`` of an angle in rad.
    """

    time: str = ""
    measured: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for role in ROLES.values():
            names = getattr(self, role)
            if isinstance(names, str) or not all(isinstance(name, str) and name for name in names):
                raise ValueError(f"{role} must be names of columns, got {names!r}")
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"{role} names {', '.join(twice)} twice")
            object.__setattr__(self, role, tuple(names))


@dataclass(frozen=True)
class Record:
    """Samples from one run of a plant. Shapes: ``t`` (n,), ``y`` (n, ny), ``u`` (n, nu), ``x`` (n, nx)."""

    name: str
    t: np.ndarray
    y: np.ndarray
    u: np.ndarray | None = None
    x: np.ndarray | None = None
    signals: Signals = field(default_factory=Signals)
    source: str = ""
    environment: Mapping[str, Any] | None = None

    @np.errstate(invalid="ignore")
    def __post_init__(self) -> None:
        for letter in "tyux":
            values = getattr(self, letter)
            if values is not None or letter in "ty":
                object.__setattr__(self, letter, real_array(f"{self.name}: {letter}", values))
        if np.ndim(self.t) != 1 or len(self.t) < 2:
            raise ValueError(f"{self.name}: t must hold at least two samples, got shape {np.shape(self.t)}")
        names: dict[str, Any] = {"time": self.signals.time or "t"}
        columns = [("t", names["time"], self.t)]
        for letter, role in ROLES.items():
            if (values := getattr(self, letter)) is None:
                continue
            if values.ndim != 2 or len(values) != len(self.t) or not values.shape[1]:
                raise ValueError(
                    f"{self.name}: {letter} must have shape ({len(self.t)}, n) as there are {len(self.t)} times, "
                    f"got {values.shape}"
                )
            names[role] = getattr(self.signals, role) or tuple(f"{letter}{i + 1}" for i in range(values.shape[1]))
            if len(names[role]) != values.shape[1]:
                raise ValueError(f"{self.name}: {letter} has {values.shape[1]} columns, but {role} = {names[role]}")
            columns += [(letter, name, column) for name, column in zip(names[role], values.T, strict=True)]
        object.__setattr__(self, "signals", replace(self.signals, **names))
        for letter, name, column in columns:
            missing, back = np.isnan(column), np.append(False, np.diff(self.t) <= 0)
            for wrong, why in (
                (abs(column) > MAX_SAMPLE, "{0:g} is not a valid sample"),
                (missing & missing.all(), "no row holds a number"),
                (missing & (letter in "tu"), "a number is missing; only outputs and states may lack samples"),
                (back & (letter == "t"), "time must increase, but {0:g} comes after {1:g}"),
            ):
                if wrong.any():
                    row = int(wrong.argmax())
                    why = why.format(column[row], column[row - 1])
                    raise ValueError(f"{self.name}: column {name}, row {row + 1}: {why}")

    def part(self, rows: slice) -> "Record":
        """Return the given rows, two or more, as a record; it has no states if no row has all of them."""
        u, x = (None if values is None else values[rows] for values in (self.u, self.x))
        if x is not None and np.isnan(x).any(-1).all():
            x = None
        return replace(self, t=self.t[rows], y=self.y[rows], u=u, x=x)

    @property
    def fingerprint(self) -> str:
        """Hash of the samples and of the names of their signals."""
        digest = hashlib.sha256(repr(self.signals).encode())
        for values in (self.t, self.y, self.u, self.x):
            digest.update(b"" if values is None else np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()[:16]

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.t[-1] - self.t[0])


def median_step(*records: Record) -> float:
    """Return the median time step in seconds of one or more records."""
    return float(np.median(np.concatenate([np.diff(record.t) for record in records])))


def sampling_interval(*records: Record) -> float:
    """Return the median step in seconds, rounded to the digits on which all steps agree, and to at least two."""
    uneven = max(map(jitter, records))
    digits = 12 if uneven < 1e-12 else int(np.clip(-np.log10(uneven), 2, 12))
    return float(f"{median_step(*records):.{digits}g}")


def jitter(record: Record) -> float:
    """Return the largest deviation of a time step from the nearest multiple of the median step, in median steps."""
    steps = np.diff(record.t) / median_step(record)
    return float(np.max(abs(steps - np.maximum(steps.round(), 1.0))))


def resampled(record: Record, dt: float | None = None) -> Record:
    """Put a record on a uniform grid that begins with its first sample.

    Outputs are interpolated linearly, as the filter assumes, so that a value depends on no sample after the next one.
    States, which no observer sees, follow a monotone cubic (PCHIP). Outputs and states are NaN in gaps of over 3 dt.
    Inputs, held between samples, are averaged over each interval of the grid. A complete record that already has this
    grid changes only by rounding.
    """
    dt = median_step(record) if dt is None else dt
    if not 0 < dt <= record.duration * (1 + ROUNDING):
        raise ValueError(f"{record.name}: dt = {dt:g} s must lie between 0 and its duration, {record.duration:g} s")
    steps = int(np.floor(record.duration / dt + ROUNDING))
    if steps > MOST_STEPS * len(record.t):
        row = int(np.diff(record.t).argmax())
        raise ValueError(
            f"{record.name}: column {record.signals.time}, row {row + 2}: {record.t[row + 1]:.10g} comes after "
            f"{record.t[row]:.10g} s; split the record at this jump of the time, or correct it"
        )
    t = np.minimum(record.t[0] + dt * np.arange(steps + 1), record.t[-1])
    signals, columns = record.signals, [] if record.x is None else list(record.x.T)
    y = [_interpolated(record, name, values, t, smooth=False) for name, values in zip(signals.measured, record.y.T)]
    x = [_interpolated(record, name, values, t, smooth=True) for name, values in zip(signals.hidden, columns)]
    return replace(record, t=t, y=np.stack(y, -1), u=_held(record, t, dt), x=np.stack(x, -1) if x else None)


def _interpolated(record: Record, name: str, values: np.ndarray, t: np.ndarray, *, smooth: bool) -> np.ndarray:
    """Interpolate a column at the times t of a grid, with NaN in gaps."""
    there = ~np.isnan(values)
    at, values, dt = record.t[there], values[there], t[1] - t[0]
    close = np.zeros(len(t), dtype=bool)
    if len(at) > 1:
        after = np.clip(np.searchsorted(at, t - ROUNDING * dt), 1, len(at) - 1)
        inside = (t >= at[0]) & (t <= at[-1]) & (at[after] - at[after - 1] <= LONGEST_GAP * dt * (1 + ROUNDING))
        close = inside | (np.minimum(abs(t - at[after - 1]), abs(t - at[after])) <= ROUNDING * dt)
    if close.sum() < 2 or not (smooth or (close[1:] & close[:-1]).any()):  # a filter needs consecutive samples
        raise ValueError(
            f"{record.name}: column {name}: too few samples are within {LONGEST_GAP:g} dt = {LONGEST_GAP * dt:.3g} s "
            "of each other; take a larger dt"
        )
    return np.where(close, PchipInterpolator(at, values)(t) if smooth else np.interp(t, at, values), np.nan)


def _held(record: Record, t: np.ndarray, dt: float) -> np.ndarray | None:
    """Return the means of held inputs over the intervals that begin at t; the last input is held beyond the end."""
    if record.u is None:
        return None
    ends = np.append(record.t, max(record.t[-1], t[-1]) + 2 * dt)
    total = np.concatenate([np.zeros((1, record.u.shape[1])), np.cumsum(np.diff(ends)[:, None] * record.u, 0)])
    means = [(np.interp(t + dt, ends, column) - np.interp(t, ends, column)) / dt for column in total.T]
    return np.stack(means, -1)


def pieces(records: Iterable[Record]) -> list[Record]:
    """Split records at rows that lack an output, because no filter runs across a gap."""
    parts = []
    for record in records:
        whole = ~np.isnan(record.y).any(-1)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(int)))
        parts += [record.part(slice(int(a), int(b))) for a, b in zip(edges[::2], edges[1::2]) if b - a > 1]
    return parts


class Windows:
    """The pieces of some records between gaps, concatenated, with a filter that runs along each piece.

    Shapes: ``y`` (n, ny), ``u`` (n, nu), ``x`` (n, nx; NaN where unknown), ``z`` (n, size), and ``before`` and
    ``after`` (n,): numbers of samples before and after each sample in its piece.
    """

    def __init__(self, records: Iterable[Record], linear: LinearFilter, nx: int) -> None:
        parts, nu, self.linear = pieces(records), linear.nu, linear
        counts = [np.arange(len(part.t)) for part in parts]
        self.before = np.concatenate([np.zeros(0, int), *counts])
        self.after = np.concatenate([np.zeros(0, int), *(count[::-1] for count in counts)])
        u = (part.u if nu and part.u is not None else np.zeros((len(part.t), nu)) for part in parts)
        x = (np.full((len(part.t), nx), np.nan) if part.x is None else part.x for part in parts)
        self.y = np.concatenate([np.zeros((0, linear.B.shape[1])), *(part.y for part in parts)])
        self.u, self.x = np.concatenate([np.zeros((0, nu)), *u]), np.concatenate([np.zeros((0, nx)), *x])

    def rows(self, age: int = 0) -> np.ndarray:
        """Return the indices of samples with a known state and at least ``age`` samples before them."""
        return np.flatnonzero((self.before >= age) & ~np.isnan(self.x).any(-1))

    @cached_property
    def z(self) -> np.ndarray:
        """States of a filter that starts at the first sample of each piece."""
        z, first, linear = np.zeros((len(self.y), self.linear.size)), np.flatnonzero(self.before == 0), self.linear
        z[first] = linear.start(self.y[first])
        for k in range(1, self.before.max(initial=0) + 1):
            rows = first[self.after[first] >= k] + k
            z[rows] = linear.advance(z[rows - 1], self.y[rows - 1], self.u[rows - 1], self.y[rows])
        return z

    def restarted(self, rows: np.ndarray, age: int) -> np.ndarray:
        """Return, by linearity, z at the samples ``rows`` as if the filter had started ``age`` samples before each."""
        began = rows - age
        power = np.linalg.matrix_power(self.linear.transition, age)
        return np.asarray(self.z[rows] + (self.linear.start(self.y[began]) - self.z[began]) @ power.T)
