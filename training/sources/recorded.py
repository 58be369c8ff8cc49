"""Recorded motions: files, data sets, or rollouts of an environment, in which the hidden signals were seen."""

import functools
import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from observers import Artifact, Equations, LinearFilter
from observers.checks import shown
from training.config import Config
from training.maps.coordinates import settling_time
from training.records import (
    Record,
    Signals,
    check_dt,
    check_memory,
    check_signals,
    jitter,
    median_step,
    pieces,
    resampled,
)
from training.seeds import Stream, generator
from training.sources.errors import recorded_errors
from training.sources.output import linear_output
from training.sources.source import Increments, Pairs, Report, Runs, TooFewRunsError
from training.sources.windows import samples_as_old, windows
from training.spectrum import Spectrum
from training.trajectories.record import recording_ages

FEW = 5  # records, below which none is held out as a whole
STRETCHES, SAMPLES = 600, 2_000_000  # at most, of stretches to calibrate on and of their samples together
MEMORIES = 2.0  # of the filter's memory, that stretches are long at most
FEWEST = 50  # samples that a stretch may begin at
BEYOND = 0.5  # of the states' range, by which estimates may leave it
INCREMENTS = 400_000  # at most
WINDOW = 10  # samples at least over which innovations are averaged


class RecordedSource:
    """Recorded motions of a plant whose equations are unknown.

    Parameters
    ----------
    records : sequence of Record
        Records with hidden states, all of the same signals.
    config : Config
        What concerns them: dt, samples, windows, held_out, inputs, arbitrary_zero, seed.
    name : str
        Of the observer.
    held_out : sequence of Record, optional
        What is not trained on; by default a share of the records.
    C : ndarray, shape (ny, nx), optional
        The output y = C x, where it is known; by default it is fitted.
    warn : callable, optional
        Called with the text of a warning.

    Raises
    ------
    ValueError
        If no hidden states were recorded, or a signal is unknown.
    """

    def __init__(
        self,
        records: Sequence[Record],
        config: Config,
        name: str,
        *,
        held_out: Sequence[Record] | None = None,
        C: np.ndarray | None = None,
        warn: Callable[[str], object] = lambda text: None,
    ) -> None:
        if not records or any(record.x is None for record in records):
            raise ValueError("no hidden states were recorded; name their columns (--hidden), or give equations")
        check_signals([*records, *(held_out or ())])
        check_dt(records, config.dt)
        self.records, self.config, self.name, self.C = records, config, name, C
        self.signals: Signals = records[0].signals
        if unknown := [name for name in config.arbitrary_zero if name not in self.signals.measured]:
            raise ValueError(
                f"arbitrary_zero names {', '.join(map(repr, unknown))}; measured are {', '.join(self.signals.measured)}"
            )
        self.nx, self.ny = len(self.signals.hidden), len(self.signals.measured)
        self.nu = len(self.signals.inputs) if config.inputs else 0
        self.dt, self.process_noise = config.dt, 0.0
        self.linear = Spectrum(config.eigenvalues, config.pairs).filter(self.ny, config.dt, self.nu)
        check_memory(records, settling_time(self.linear), lambda text: warn(f"warning: {text}"))
        kept = [resampled(record, config.dt) for record in records]
        if held_out is None:
            kept, apart = split(kept, config.held_out, config.seed)
        else:
            apart = [resampled(record, config.dt) for record in held_out]
        self.kept, self.held_out = kept, apart
        self.rate = signal_rate(kept)
        self.pace = 1 / self.rate

    def identity(self) -> dict[str, Any]:
        """What identifies the source."""
        return {"name": self.name, "records": [record.fingerprint for record in self.records]}

    def facts(self) -> dict[str, Any]:
        """Arguments of :class:`observers.Artifact`."""
        signals = self.signals
        inputs = signals.inputs if self.nu else ()
        found = {
            "system": self.name,
            "parameters": {},
            "measurement_noise": 0.0,
            "signals": {"measured": signals.measured, "inputs": inputs, "hidden": signals.hidden},
            "environment": self.records[0].environment,
        }
        try:
            return found | {"C": self._output()[0]}
        except ValueError:  # tracking() says why
            return found

    def sampling(self, linear: LinearFilter) -> dict[str, Any]:
        """Arguments of :class:`training.maps.samplers.TrajectorySampler`."""
        zero = [self.signals.measured.index(name) for name in self.config.arbitrary_zero]
        return {"measurement_noise": 0.0, "silent": linear.equilibrium[:, zero]}

    def pairs(self, linear: LinearFilter, *, free: bool = False, report: Report = lambda done: None) -> Pairs:
        """Recorded states with what the filter holds if it was switched on some samples before."""
        ages = recording_ages(math.ceil(settling_time(linear) / self.dt), self.config.samples)
        return windows(pieces(self.kept), linear, ages=ages, n=self.config.windows)

    def runs(self, *, report: Report = lambda done: None) -> Runs:
        """Stretches of what was held out, side by side, from samples all over it."""
        whole = [piece for piece in pieces(self.held_out) if piece.x is not None and len(piece.t) > 2]
        owner = first = np.zeros(0, int)
        if whole:
            owner, first = samples_as_old([piece.part(slice(None, -1)) for piece in whole], 0)
        if len(owner) < FEWEST:
            raise TooFewRunsError(
                f"what was held out has {len(owner)} samples with states to begin at, too few to calibrate on "
                f"({FEWEST}): record more, or hold more out (--set held_out=0.3)"
            )
        memory = settling_time(self.linear) / self.dt
        steps = max(2, min(round(MEMORIES * memory), max(len(piece.t) for piece in whole) - 1))
        most = min(STRETCHES, max(2 * FEWEST, SAMPLES // steps))
        if len(owner) > most:
            chosen = np.linspace(0, len(owner) - 1, most).round().astype(int)
            owner, first = owner[chosen], first[chosen]
        rows = first + np.arange(steps + 1)[:, None]
        lengths = np.array([len(piece.t) for piece in whole])
        begins = np.concatenate([[0], np.cumsum(lengths)])[owner]
        where = begins + np.minimum(rows, lengths[owner] - 1)
        x = np.concatenate([np.asarray(piece.x) for piece in whole])[where]
        x[rows >= lengths[owner]] = np.nan
        u = np.zeros((steps, len(first), 0))
        if self.nu:
            u = np.concatenate([np.asarray(piece.u) for piece in whole])[where[:-1]]
        y = np.concatenate([piece.y for piece in whole])[where]
        return Runs(x, y, u, process_noise=np.zeros(len(first)), usual=np.ones(len(first), dtype=bool))

    def equations(self) -> Equations:
        """There are none."""
        raise ValueError("records have no equations")

    def increments(self, *, report: Report = lambda done: None) -> tuple[Increments, Increments]:
        """How states change from each recorded sample to the next, on what is trained on and what is held out."""
        return self._both_increments

    @functools.cached_property
    def _both_increments(self) -> tuple[Increments, Increments]:
        return self._increments(self.kept), self._increments(self.held_out)

    def _increments(self, records: Sequence[Record]) -> Increments:
        found = list[tuple[np.ndarray, ...]]()
        for record in pieces(records):
            if record.x is not None:
                u = record.u[:-1] if self.nu and record.u is not None else np.zeros((len(record.t) - 1, 0))
                found.append((record.x[:-1], u, np.diff(record.x, axis=0)))
        x, u, change = (np.concatenate(each) for each in zip(*found)) if found else (np.zeros((0, 1)),) * 3
        known = np.flatnonzero(np.isfinite(x + change).all(-1))
        if not len(known):
            raise ValueError(
                "no two samples in a row have all hidden signals: record them at each sample, or take a larger dt"
            )
        if len(known) > INCREMENTS:
            known = generator(Stream.CALIBRATION, self.config.seed, 11).choice(known, INCREMENTS, replace=False)
        return Increments(x[known], u[known], change[known])

    def judged(self, artifact: Artifact) -> dict[str, Any]:
        """Errors on what was held out, relative to the signals' standard deviations."""
        found = recorded_errors(artifact, self.held_out)
        known = {signal: error for signal, error in found.relative.items() if math.isfinite(error)}
        return {"records": fingerprints(self.records), "held_out_errors": known, "held_out_after": found.after}

    def tracking(self) -> dict[str, Any]:
        """Arguments of :class:`observers.Motion` beside the flow; ValueError where nothing can track."""
        if self.config.arbitrary_zero:
            raise ValueError(
                f"a tracker compares {', '.join(self.config.arbitrary_zero)} with what it predicts, and cannot do "
                "without the zero: train without arbitrary_zero"
            )
        if not self.held_out:
            raise ValueError("covariances are calibrated on what is held out: held_out must be positive, got 0")
        _, least = self._output()
        _ = self._both_increments  # or the reason why there are none
        x = np.concatenate([record.x for record in self.kept if record.x is not None])
        x = x[np.isfinite(x).all(-1)]
        low, high = x.min(0), x.max(0)
        margin = np.where(high > low, BEYOND * (high - low), 1.0)
        return {
            "low": low - margin,
            "high": high + margin,
            "mean": x.mean(0),
            "covariance": np.atleast_2d(np.cov(x.T)) + np.diag(1e-6 * margin**2),
            "process_noise": np.zeros(self.nx),  # the flow's error stands for all noise
            "least_process_noise": 1.0,
            "least_measurement_noise": least,
            "window": max(WINDOW * self.dt, 0.5 / self.rate),
        }

    def _output(self) -> tuple[np.ndarray, np.ndarray]:
        return linear_output(self.kept, self.C)


def split(records: Sequence[Record], share: float, seed: int) -> tuple[list[Record], list[Record]]:
    """Hold a share of the records out: whole ones drawn by the seed, or the end of each where there are few."""
    if not share:
        return list(records), []
    if len(records) >= FEW:
        count = min(max(1, round(share * len(records))), len(records) - 1)
        chosen = generator(Stream.VALIDATION, seed).permutation(len(records))[:count]
        return [r for i, r in enumerate(records) if i not in chosen], [records[i] for i in sorted(chosen)]
    ends = [min(max(2, round((1 - share) * len(record.t))), len(record.t) - 2) for record in records]
    return (
        [record.part(slice(None, end)) for record, end in zip(records, ends)],
        [record.part(slice(end, None)) for record, end in zip(records, ends)],
    )


def check_plant(artifact: Artifact, record: Record) -> None:
    """Raise ValueError unless a record is of an observer's environment and signals, states among them."""
    signals, names = record.signals, artifact.signals or {}
    if record.x is None:
        raise ValueError(f"{record.name}: no hidden states were recorded; name them (--hidden)")
    for role in ("measured", "hidden", *(["inputs"] if artifact.nu else [])):
        if (here := getattr(signals, role)) != (there := tuple(names[role])):
            raise ValueError(f"{record.name}: {role} are {', '.join(here)}, but the observer's {', '.join(there)}")
    if record.environment != artifact.environment:
        raise ValueError(
            f"{record.name} is of {shown(record.environment)}, the observer of {shown(artifact.environment)}"
        )


def fingerprints(records: Sequence[Record]) -> dict[str, str]:
    """What identifies each file, or all episodes of a data set together, by its name."""
    found = dict[str, list[str]]()
    for record in records:
        found.setdefault(record.source or Path(record.name).name, []).append(record.fingerprint)
    return {
        name: each[0] if len(each) == 1 else hashlib.sha256("".join(each).encode()).hexdigest()[:16]
        for name, each in found.items()
    }


def described(source: RecordedSource) -> list[str]:
    """What is going to be done."""
    signals, records, config = source.signals, source.records, source.config
    given = " and ".join(", ".join(names) for names in (signals.measured, signals.inputs) if names)
    uneven, seconds = max(map(jitter, records)), sum(record.duration for record in records)
    lacking = sum(int(np.isnan(record.y).any(-1).sum()) for record in records)
    rates = Spectrum(config.eigenvalues, config.pairs).poles.real
    return [
        f"training an observer for {source.name} from recorded states: {', '.join(signals.hidden)} from {given}",
        f"{len(records)} records of {seconds:.4g} s together, {lacking} rows without an output",
        f"steps of {median_step(*records):.4g} s (median), uneven by up to {uneven:.1%}; resampled to {config.dt:g} s",
        f"{len(rates)} modes of A for each output, from {rates.max():.3g} to {rates.min():.3g} 1/s",
    ]


def signal_rate(records: Sequence[Record]) -> float:
    """How fast signals change, in 1/s: rms of the derivative over standard deviation, the median of those that move."""
    rates = list[float]()
    for letter in "yx":
        columns = [getattr(record, letter) for record in records if getattr(record, letter) is not None]
        if columns:
            steps = [np.diff(values, axis=0) / np.diff(record.t)[:, None] for values, record in zip(columns, records)]
            change = np.concatenate(steps)
            change = np.sqrt(np.nansum(change**2, 0) / np.maximum(np.isfinite(change).sum(0), 1))
            size = np.nanstd(np.concatenate(columns), 0)
            rates += (change[size > 0] / size[size > 0]).tolist()
    moving = [rate for rate in rates if rate > 0]
    if not moving:
        raise ValueError(f"{records[0].name}: no signal moves, nor in any other record; there is nothing to learn from")
    return float(np.median(moving))


__all__ = ["RecordedSource", "check_plant", "described", "fingerprints", "signal_rate", "split"]
