"""Recorded motions from files, data sets, or rollouts of an environment, with their hidden signals."""

import contextlib
import functools
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from observers import Artifact, Equations, KKLObserver, LinearFilter
from training.config import Config
from training.maps.coordinates import SETTLED, settling_time
from training.records import check_dt, check_signals, jitter, median_step, sampling_interval
from training.records.record import ROLES, Record, Windows, pieces, resampled
from training.seeds import Stream, generator
from training.sources import OF_MEDIAN, Increments, Pairs, Report, Runs, TooFewRunsError
from training.spectrum import FASTEST_MODE, Spectrum, evenly_spaced
from training.trajectories.motions import recording_ages

FEW = 5  # with this many records or more, whole records are held out; with fewer, the end of each
STRETCHES, SAMPLES = 600, 2_000_000  # largest numbers for calibration; 100 stretches of records may have more samples
STRETCH_MEMORIES = 2.0  # greatest length of a stretch, in settling times of the filter
FEWEST = 50  # calibration needs at least this many samples at which a stretch may begin
BEYOND = 0.5  # a tracker's estimates may leave the range of each recorded state by this fraction of the range
INCREMENTS = 400_000  # largest number of state changes over dt from which an observers.Flow is learned
WINDOW = 10  # least number of samples over which a tracker averages innovations
UNEXPLAINED = 0.7  # a larger residual of y = C x, in standard deviations of the output, is not mere noise
ROUNDING, OUTLIER = 1e-6, 6.0  # rounding, as a share of an output; least outlier, in the residual's standard deviations
LEAST_NOISE = 1e-4  # least noise that a tracker assumes, in standard deviations of the outputs, as R must not be 0
MODES, SLOWEST, FASTEST = 12, 0.15, 10.0  # for records: modes of each output; their rates in multiples of signal_rate
RECORD_MEMORIES = 3.0  # least number of settling times in a median record; fewer if all modes would exceed signal_rate
# For rollouts, whose hidden signals an agent needs within a few steps: number of modes of each output, and their rates
# per step. A few modes that lie far apart forget the start soon, and distinguish single steps.
EPISODE_MODES, EPISODE_SLOWEST, EPISODE_FASTEST = 6, 0.2, 4.0
EPISODE_MEMORIES = 1.5  # least number of settling times in a median episode; fewer if it is shorter than about 10 steps
RECORDED_NOISE = 0.1  # largest noise that training adds to the records, in standard deviations of the output
RECORDED: dict[str, Any] = {
    "samples": 60, "width": 96, "depth": 2, "learning_rate": 3e-3, "inverse_steps": 3000, "members": 3,
    "noise_free_share": 0.5, "scaling": "range",
}  # fmt: skip
OF_THE_FILTER = ("eigenvalues", "pairs", "dt", "inputs", "arbitrary_zero")  # settings that determine the filter


class RecordedSource:
    """Recorded motions of a plant whose equations are unknown.

    Parameters
    ----------
    records : sequence of Record
        Records with hidden states, all of the same signals.
    config : Config
        Settings of the training. The source itself reads eigenvalues, pairs, dt, samples, windows, held_out, inputs,
        arbitrary_zero and seed.
    name : str
        Name of the observer.
    held_out : sequence of Record, optional
        Records to hold out from training; by default a share of ``records``.
    C : ndarray, shape (ny, nx), optional
        Matrix of the output y = C x if it is known; by default it is fitted.

    Raises
    ------
    ValueError
        If a record has no hidden states, records have different signals, ``arbitrary_zero`` names a signal that is
        not measured, no signal moves, or dt does not suit the records.
    """

    def __init__(
        self,
        records: Sequence[Record],
        config: Config,
        name: str,
        *,
        held_out: Sequence[Record] | None = None,
        C: np.ndarray | None = None,
    ) -> None:
        if not records or any(record.x is None for record in records):
            raise ValueError("no hidden states were recorded; name their columns (--hidden), or give equations")
        check_signals([*records, *(held_out or ())])
        check_dt(records, config.dt)
        self.records, self.config, self.name, self.C, signals = records, config, name, C, records[0].signals
        if unknown := [name for name in config.arbitrary_zero if name not in signals.measured]:
            measured = ", ".join(signals.measured)
            raise ValueError(f"arbitrary_zero names {', '.join(map(repr, unknown))}, but measured are {measured}")
        self.signals, self.nx, self.ny = signals, len(signals.hidden), len(signals.measured)
        self.nu, self.dt, self.process_noise = len(signals.inputs) * config.inputs, config.dt, 0.0
        self.linear = Spectrum(config.eigenvalues, config.pairs).filter(self.ny, config.dt, self.nu)
        self.kept, self.held_out = ([resampled(each, config.dt) for each in some] for some in (records, held_out or ()))
        if held_out is None:
            self.kept, self.held_out = split(self.kept, config.held_out, config.seed)
        self.pace = 1 / signal_rate(self.kept)

    def identity(self) -> dict[str, Any]:
        """Return the name, and a fingerprint of each file or data set."""
        each = dict[str, str]()
        for record in self.records:
            name = record.source or Path(record.name).name
            each[name] = each.get(name, "") + record.fingerprint
        records = {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in each.items()}
        return {"name": self.name, "records": records}

    def facts(self) -> dict[str, Any]:
        """Return the arguments of :class:`observers.Artifact` that describe the records."""
        signals = {role: getattr(self.signals, role) for role in ROLES.values()} | ({} if self.nu else {"inputs": ()})
        facts = {"system": self.name, "parameters": {}, "measurement_noise": 0.0, "signals": signals}
        facts["environment"] = self.records[0].environment
        if self.nu:
            inputs = [np.abs(each.u[:-1]).max(0, initial=0.0) for each in self.records if each.u is not None]
            facts["u_max"] = tuple(np.max(inputs, 0).tolist())
        with contextlib.suppress(ValueError):  # tracking() reports this error
            facts["C"] = linear_output(self.kept, self.C)[0]
        return facts

    def sampling(self, linear: LinearFilter) -> dict[str, Any]:
        """Return arguments of :class:`training.maps.inverse.TrajectorySampler` that depend on the records."""
        zero = [self.signals.measured.index(name) for name in self.config.arbitrary_zero]
        return {"measurement_noise": 0.0, "silent": linear.equilibrium[:, zero]}

    def pairs(self, linear: LinearFilter, *, free: bool = False, report: Report = lambda done: None) -> Pairs:
        """Return recorded states, and the states of a filter that started some samples before each of them."""
        windows, n = Windows(self.kept, linear, self.nx), self.config.windows
        ages = recording_ages(math.ceil(settling_time(linear) / self.dt), self.config.samples)
        chosen = [evenly(windows.rows(age), n) for age in ages]
        if lacking := [age for age, rows in zip(ages, chosen) if not len(rows)]:
            raise ValueError(
                f"no recorded state is {lacking[0] * self.dt:.3g} s or more after the start of its record or a gap; "
                "record longer runs, or take faster eigenvalues"
            )
        zs = [windows.restarted(rows, age) for age, rows in zip(ages, chosen)]
        return Pairs(ages, windows.x[np.stack(chosen)], np.stack(zs), np.zeros(n))

    def runs(self, *, report: Report = lambda done: None) -> Runs:
        """Return stretches of the held-out records, whose first samples are spread evenly over the records."""
        windows = Windows(self.held_out, self.linear, self.nx)
        first = windows.rows()
        first = first[windows.after[first] > 0]
        if len(first) < FEWEST:
            raise TooFewRunsError(
                f"the held-out records have {len(first)} samples at which a motion for calibration may begin, fewer "
                f"than {FEWEST}: record more, or hold more out (--set held_out=0.3)"
            )
        longest = int(windows.after[first].max())
        steps = max(2, min(round(STRETCH_MEMORIES * settling_time(self.linear) / self.dt), longest))
        first = evenly(first, min(len(first), STRETCHES, max(2 * FEWEST, SAMPLES // steps)))
        later = np.minimum(np.arange(steps + 1)[:, None], windows.after[first])
        x = windows.x[first + later]
        x[later < np.arange(steps + 1)[:, None]] = np.nan
        usual = np.ones(len(first), dtype=bool)
        return Runs(x, windows.y[first + later], windows.u[first + later[:-1]], np.zeros(len(first)), usual)

    def equations(self) -> Equations:
        """Raise ValueError, as records have no equations."""
        raise ValueError("records have no equations")

    def increments(self, *, report: Report = lambda done: None) -> tuple[Increments, Increments]:
        """Return changes of the state over one sampling interval, in the training records and in the held-out ones."""
        return self._increments

    @functools.cached_property
    def _increments(self) -> tuple[Increments, Increments]:
        both = list[Increments]()
        for records in (self.kept, self.held_out):
            windows = Windows(records, self.linear, self.nx)
            rows = windows.rows(1) - 1
            rows = rows[~np.isnan(windows.x[rows]).any(-1)]
            if not len(rows):
                raise ValueError(
                    "no consecutive samples have all hidden signals: record them at each sample, or take a larger dt"
                )
            if len(rows) > INCREMENTS:
                rows = generator(Stream.CALIBRATION, self.config.seed, 11).choice(rows, INCREMENTS, replace=False)
            both.append(Increments(windows.x[rows], windows.u[rows], windows.x[rows + 1] - windows.x[rows]))
        return both[0], both[1]

    def judged(self, artifact: Artifact) -> dict[str, Any]:
        """Return errors on the held-out records, relative to the signals' standard deviations."""
        errors = recorded_errors(artifact, self.held_out)
        return {
            "records": self.identity()["records"],
            "held_out_errors": {name: error for name, error in errors.items() if math.isfinite(error)},
            "held_out_after": settling_time(artifact.filter),
        }

    def tracking(self) -> dict[str, Any]:
        """Return the arguments of observers.Motion that records determine; ValueError if tracking is impossible."""
        if self.config.arbitrary_zero:
            raise ValueError(
                f"a tracker compares {', '.join(self.config.arbitrary_zero)} with its prediction, so the zero matters: "
                "train without arbitrary_zero"
            )
        if not self.held_out:
            raise ValueError("covariances are calibrated on held-out records: held_out must be positive, got 0")
        _, least = linear_output(self.kept, self.C)
        _ = self._increments  # raises ValueError if the records hold no increments
        x = np.concatenate([record.x for record in self.kept if record.x is not None])
        x = x[np.isfinite(x).all(-1)]
        low, high = x.min(0), x.max(0)
        margin = np.where(high > low, BEYOND * (high - low), 1.0)
        return {
            "low": low - margin,
            "high": high + margin,
            "mean": x.mean(0),
            "covariance": np.atleast_2d(np.cov(x.T)) + np.diag(1e-6 * margin**2),
            "process_noise": np.zeros(self.nx),  # the flow's error covers all process noise
            "least_process_noise": 1.0,
            "least_measurement_noise": least,
            "window": max(WINDOW * self.dt, 0.5 * self.pace),
        }

    def described(self) -> str:
        """Describe the signals and the records in a sentence."""
        signals, records = self.signals, self.records
        given = " and ".join(", ".join(names) for names in (signals.measured, signals.inputs) if names)
        seconds, step = sum(record.duration for record in records), median_step(*records)
        text = f"training an observer for {self.name} from recorded states: {', '.join(signals.hidden)} from {given}; "
        steps = f"steps of {step:.4g} s (median), uneven by up to {max(map(jitter, records)):.1%}"
        return text + f"{len(records)} records of {seconds:.4g} s together, in {steps}; resampled to {self.dt:g} s"


def recorded_preset(records: Sequence[Record], changes: Mapping[str, Any] | None = None) -> Config:
    """Return a configuration for records, which determine dt, the eigenvalues of A, and the largest noise.

    dt is the rounded median time step. The eigenvalues follow from the signals' rate and the records' length, those for
    rollouts from dt and the episodes' length. The largest noise is a tenth of each output's standard deviation.

    Parameters
    ----------
    records : sequence of Record
        Records of the same signals.
    changes : mapping of str to object, optional
        Settings to replace; None keeps a setting.

    Returns
    -------
    Config
        The configuration, for :class:`training.RecordedSource`.

    Raises
    ------
    ValueError
        If dt does not suit the records, an output never changes (unless its noise is set), or a setting is invalid.
    """
    given = {name: value for name, value in (changes or {}).items() if value is not None}
    chosen: dict[str, Any] = {"dt": sampling_interval(*records), **RECORDED} | given
    dt, step, environment = chosen["dt"], median_step(*records), records[0].environment
    check_dt(records, dt)
    if environment is not None and not np.isclose(dt, step, rtol=1e-6):
        raise ValueError(f"dt = {dt:g} s: {environment['id']} shows a sample every {step:g} s; leave dt out")
    if records[0].source:
        settled = EPISODE_MEMORIES * SETTLED / float(np.median([len(record.t) for record in records]))
        slowest = min(max(EPISODE_SLOWEST, settled), EPISODE_FASTEST / 4)
        spaced = evenly_spaced(EPISODE_MODES, -slowest / dt, -EPISODE_FASTEST / dt)
    else:
        rate, length = signal_rate(records), np.median([record.duration for record in records])
        slowest = min(max(SLOWEST * rate, RECORD_MEMORIES * SETTLED / length), rate)
        spaced = evenly_spaced(MODES, -slowest, -min(FASTEST * rate, FASTEST_MODE / dt))
    spread = np.nanstd(np.concatenate([record.y for record in records]), 0)
    levels = tuple(float(f"{RECORDED_NOISE * size:.3g}") for size in spread)
    still = [name for name, level in zip(records[0].signals.measured, levels) if not level]
    if still and "measurement_noise_max" not in given:
        raise ValueError(f"{', '.join(still)} never changes: leave it out of the measured signals")
    defaults = {
        "duration": max(50.0, dt),
        "eigenvalues": tuple(float(f"{value:.6g}") for value in spaced),
        "measurement_noise_max": levels[0] if len(levels) == 1 else levels,
    }
    return Config("input-aware", **defaults | chosen)


def evenly(rows: np.ndarray, n: int) -> np.ndarray:
    """Choose n rows, evenly spread, with repetitions if there are fewer; return no row if there are no rows."""
    return rows[np.linspace(0, len(rows) - 1, n if len(rows) else 0).round().astype(int)]


def split(records: Sequence[Record], share: float, seed: int) -> tuple[list[Record], list[Record]]:
    """Return kept and held-out records: records drawn by the seed are held out, or the end of each if there are few."""
    if not share:
        return list(records), []
    if len(records) >= FEW:
        count = min(max(1, round(share * len(records))), len(records) - 1)
        chosen = generator(Stream.VALIDATION, seed).permutation(len(records))[:count]
        return [r for i, r in enumerate(records) if i not in chosen], [records[i] for i in sorted(chosen)]
    ends = [min(max(2, round((1 - share) * len(record.t))), len(record.t) - 2) for record in records]
    return (  # a record of fewer than four samples is kept whole
        [record.part(slice(None, end)) if end > 1 else record for record, end in zip(records, ends)],
        [record.part(slice(end, None)) for record, end in zip(records, ends) if end > 1],
    )


def signal_rate(records: Sequence[Record]) -> float:
    """Return the median rate of all moving signals in 1/s: the derivative's rms divided by the standard deviation."""
    rates = list[float]()
    for letter in "yx":
        signals = [(getattr(record, letter), record.t) for record in records if getattr(record, letter) is not None]
        if signals:
            slopes = np.concatenate([np.diff(values, axis=0) / np.diff(t)[:, None] for values, t in signals])
            change = np.sqrt(np.nansum(slopes**2, 0) / np.maximum(np.isfinite(slopes).sum(0), 1))
            size = np.nanstd(np.concatenate([values for values, _ in signals]), 0)
            rates += (change[size > 0] / size[size > 0]).tolist()
    moving = [rate for rate in rates if rate > 0]
    if not moving:
        raise ValueError(f"{records[0].name}: no signal moves in this or any other record, so nothing can be learned")
    return float(np.median(moving))


def recorded_errors(
    artifact: Artifact,
    records: Sequence[Record],
    after: float | None = None,
    *,
    measurement_noise: float | tuple[float, ...] = 0.0,
) -> dict[str, float]:
    """Return hidden signals' rms errors from ``after`` s on (None: settling time), divided by std; NaN if undefined."""
    first = math.ceil((settling_time(artifact.filter) if after is None else after) / artifact.filter.dt - 1e-6)
    pairs, rng, observer = list[np.ndarray](), np.random.default_rng(0), KKLObserver(artifact, measurement_noise)
    for record in pieces(records):
        if record.x is not None:
            y = record.y + np.asarray(measurement_noise) * rng.standard_normal(record.y.shape)
            x_hat = observer.estimate(y, record.u if artifact.nu else None)
            pairs.append(np.stack([x_hat - record.x, record.x], 1)[first:])
    both = np.concatenate([np.zeros((0, 2, artifact.nx)), *pairs])
    error, x = np.moveaxis(both[~np.isnan(both).any((1, 2))], 1, 0)
    names = (artifact.signals or {})["hidden"]
    if not len(error):
        return dict.fromkeys(names, math.nan)
    moves = np.ptp(x, 0) > 0  # by rounding, a constant may have a positive standard deviation
    return dict(zip(names, (np.sqrt(np.mean(error**2, 0)) / np.where(moves, x.std(0), np.nan)).tolist()))


def linear_output(records: Sequence[Record], known: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Fit C (ny, nx) of y = C x unless it is known; return C and the noise levels (ny,) that the residual suggests."""
    y, x = (np.concatenate([getattr(record, name) for record in records if record.x is not None]) for name in "yx")
    both = np.isfinite(np.column_stack([x, y])).all(-1)
    if not both.any():
        raise ValueError("no sample has all measured and all hidden signals; record them together")
    x, y = x[both], y[both]
    size, moves = np.sqrt(np.mean(y**2, 0)), y.std(0)
    C, left = _fitted(x, y, size) if known is None else (known, _usual(y - x @ known.T))
    least = np.maximum(left, LEAST_NOISE * np.where(moves > ROUNDING * size, moves, np.where(size > 0, size, 1.0)))
    signals, wrong = records[0].signals, left > np.maximum(UNEXPLAINED * moves, ROUNDING * size)
    if known is None and (other := [name for name, bad in zip(signals.measured, wrong) if bad]):
        raise ValueError(
            f"{', '.join(other)} is not a weighted sum of {', '.join(signals.hidden)} (without an offset), and a "
            "tracker predicts only such sums: list the measured signals, in the same units, as hidden ones too"
        )
    return C, least


def _fitted(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit C (ny, nx) of y = C x without outliers; return C and the standard deviations (ny,) of the residual."""
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
    """Estimate the standard deviations (ny,) of noise (n, ny) from medians, which outliers hardly change."""
    return np.asarray(OF_MEDIAN * np.median(np.abs(apart), axis=0))
