"""The lesson of calibration: covariances and limits of a monitor, from one pass of motions nothing was trained on."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from kkl_gym.system import System
from observers import Artifact, ErrorCovariance, Factors, InverseMap, Limits, Motion
from observers.decoder import Decoders
from observers.factors import COVERAGE
from observers.tracker import Tracker
from observers.unscented import Gaussian
from training.config import settings_of
from training.progress import ProgressBars, progress_bars
from training.sources.simulated import SimulatedSource
from training.sources.source import Runs, Source, TooFewRunsError

LEVELS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of measurement noise, in multiples of the largest in training
AGES = (0.0, 0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.35, 0.6, 1.0, 2.0, 4.0, 8.0, 16.0)  # seconds at the usual pace
PER_AGE = 6  # samples of each run about each age: at a single one all motions may be in the same phase
FEWEST = 50  # errors from which a covariance or a quantile is taken
LEAST_VARIANCE = 1e-6  # added to that of each state, over its range squared
WINDOW, WARM_UP = 0.5, 5.0  # seconds of the monitor, likewise
REPORTED = 100  # samples from report to report
MARGIN = 1.05  # on limits found among finitely many motions

Level = float | tuple[float, ...]
Group = tuple[Level, float, int]
"""Level of measurement noise, level of process noise, number of rows."""


def calibrate(
    artifact: Artifact,
    source: Source | System,
    *,
    motion: Motion | None = None,
    false_alarms: float | None = None,
    console: Any = None,
) -> Artifact:
    """Find the covariances of an observer's errors and the limits of its monitor.

    Motions that nothing was trained on are followed from their start at several levels of measurement noise. From them
    follow the covariance of T_inv's errors by level and age; the factor of the tracker's covariance, likewise; and
    the limits of the residual y - h(x_hat) in sound operation.

    Parameters
    ----------
    artifact : Artifact
        An observer.
    source : Source or System
        What it was made for.
    motion : Motion, optional
        By which it is to track; by default the one that it has, if any.
    false_alarms : float, optional
        Probability that a sound motion of twenty seconds, at the pace of the shipped systems, exceeds a limit; by
        default that of its training.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown.

    Returns
    -------
    Artifact
        The same with covariances and limits.

    Raises
    ------
    ValueError
        If most motions leave the system's bounds, or too few are held out; :class:`observers.ArtifactError` (a
        ValueError) if the observer was made for another system.
    """
    if isinstance(source, System):
        artifact.check(source.name, source.parameters, dt=artifact.filter.dt, ny=source.ny, nu=source.nu)
        source = SimulatedSource(source, settings_of(artifact.training))
    if false_alarms is None:
        false_alarms = artifact.training.get("false_alarms", 0.01)
    if not 0 < false_alarms < 1:
        raise ValueError(f"false_alarms must lie between 0 and 1, got {false_alarms!r}")
    sizes, expected = (source.nx, source.ny, source.nu), (artifact.nx, artifact.ny, artifact.nu)
    if sizes != expected:
        raise ValueError(f"a source of {sizes} states, outputs and inputs does not fit an observer of {expected}")
    with progress_bars(console) as progress:
        with progress.phase("motions for calibration") as report:
            runs = source.runs(report=report)
        return _Calibration(artifact, motion or artifact.motion, source, runs, false_alarms, progress).calibrated()


@dataclass
class _Calibration:
    artifact: Artifact
    motion: Motion | None
    source: Source
    runs: Runs
    false_alarms: float
    progress: ProgressBars

    def __post_init__(self) -> None:
        artifact, steps = self.artifact, len(self.runs.u)
        dt = artifact.filter.dt
        knots = {round(age * self.source.pace / dt) for age in AGES}
        last = max(1, min(4 * steps // 5, round(AGES[-1] * self.source.pace / dt)))
        self.knots = np.array(sorted({k for k in knots if k < last} | {last}))
        between = np.sqrt(self.knots[1:] * np.maximum(self.knots[:-1], 0.5))
        edges = [0.0, *between.tolist(), float(steps)]
        counts = [PER_AGE] * len(between) + [4 * PER_AGE]
        spans = (np.linspace(low, high, count) for low, high, count in zip(edges, edges[1:], counts, strict=False))
        self.spans = [np.unique(span.round()).astype(int) for span in spans]
        self.ages = np.unique(np.concatenate(self.spans))
        self.informed = "measurement_noise" in artifact.inverse.features
        largest = (artifact.inverse if self.informed else self.source.config).measurement_noise_max
        self.levels = np.multiply.outer(LEVELS, largest)
        self.noisy = self.runs.process_noise > 0
        rng = np.random.default_rng(0)
        shape = (len(LEVELS), *self.runs.y.shape)
        self.y = self.runs.y + self.levels.reshape(len(LEVELS), 1, 1, -1) * rng.standard_normal(shape)

    def calibrated(self) -> Artifact:
        artifact = dataclasses.replace(self.artifact, motion=None, limits=None)
        monitored = artifact.knows_output and self.runs.sound
        if self.informed:
            artifact = self.with_covariances(artifact)
            if self.motion is not None:  # factors are of P as the filter has it
                artifact = dataclasses.replace(
                    artifact, motion=dataclasses.replace(self.motion, factors=Factors.ones())
                )
        if artifact.motion is None and not monitored:
            return artifact
        with self.progress.phase("calibrating", len(self.runs.y)) as report:
            distances, extremes = self.followed(artifact, report)
        if artifact.motion is not None:
            groups = (~self.noisy, self.noisy) if self.noisy.any() else (~self.noisy,)
            usual = self.runs.usual
            factors = [[self.by_knot(each, usual & group, self.factor) for each in distances] for group in groups]
            table = Factors(np.array(LEVELS), self.knots * artifact.filter.dt, np.array(factors))
            artifact = dataclasses.replace(artifact, motion=dataclasses.replace(artifact.motion, factors=table))
        return dataclasses.replace(artifact, limits=self.limits(extremes)) if monitored else artifact

    def groups(self) -> list[tuple[int, np.ndarray, Any, float]]:
        """For each level, and for runs with and without process noise: its index, their rows, and both levels."""
        parts = [np.flatnonzero(group) for group in (~self.noisy, self.noisy) if group.any()]
        return [
            (i, rows, _as_level(level), float(self.runs.process_noise[rows[0]]))
            for i, level in enumerate(self.levels)
            for rows in parts
        ]

    def with_covariances(self, artifact: Artifact) -> Artifact:
        """The covariance of T_inv's errors by level and age, of each map."""
        linear, free, seconds = artifact.filter, artifact.free_inverse is not None, self.ages * artifact.filter.dt
        x = self.runs.x[self.ages]
        known = np.isfinite(x).all(-1)
        least = np.diag(LEAST_VARIANCE * np.ptp(x[known], axis=0) ** 2 + np.finfo(float).tiny)
        error = np.full((len(LEVELS), *x.shape), np.nan)
        for i, rows, level, process_noise in self.groups():
            z = linear.run(self.y[i][:, rows], self.runs.u[:, rows], self.ages)
            error[i][:, rows] = x[:, rows] - decoders(artifact, level, process_noise)(z, seconds[:, None])
        moved = np.zeros(known.shape, dtype=bool)
        acted = np.maximum.accumulate((self.runs.u != 0).any(-1), axis=0)
        moved[self.ages > 0] = acted[self.ages[self.ages > 0] - 1]
        driven = known & moved if free else known

        def with_table(inverse: InverseMap, group: np.ndarray) -> InverseMap:
            table = [self.by_knot(each, group, lambda e: _covariance(e, least)) for each in error]
            covariance = ErrorCovariance(np.array(LEVELS), self.knots * linear.dt, np.array(table))
            return dataclasses.replace(inverse, error_covariance=covariance)

        return dataclasses.replace(
            artifact,
            inverse=with_table(artifact.inverse, driven),
            free_inverse=with_table(artifact.free_inverse, known & ~moved) if artifact.free_inverse else None,
        )

    def followed(self, artifact: Artifact, report: Any) -> tuple[np.ndarray, list[np.ndarray]]:
        """Squared distances (levels, ages, n) of a tracker's errors; extremes (levels, n, ny) of residuals' means."""
        dt, groups = artifact.filter.dt, self.groups()
        observers = Together(artifact, [(level, noise, len(rows)) for _, rows, level, noise in groups])
        rows = [(i, rows) for i, rows, *_ in groups]
        y = np.concatenate([self.y[i][:, each] for i, each in rows], axis=1)
        u = np.concatenate([self.runs.u[:, each] for _, each in rows], axis=1)
        x = np.concatenate([self.runs.x[:, each] for _, each in rows], axis=1)
        share = -np.expm1(-dt / (WINDOW * self.source.pace))
        first = round(WARM_UP * self.source.pace / dt)
        mean, square = np.zeros_like(y[0]), np.zeros_like(y[0])
        largest, high, low = np.zeros_like(mean), np.zeros_like(mean), np.full_like(mean, np.inf)
        found = np.full((len(self.ages), y.shape[1]), np.nan)
        slots = {int(age): i for i, age in enumerate(self.ages)}
        for k in range(len(y)):
            x_hat = observers.reset(y[0]) if k == 0 else observers.step(y[k], u[k - 1])
            if artifact.knows_output:
                residual = artifact.residual(y[k], x_hat)
                mean += share * (residual - mean)
                square += share * (residual**2 - square)
                if k > first:
                    largest, high = np.maximum(largest, np.abs(mean)), np.maximum(high, square)
                    low = np.minimum(low, square)
            if artifact.motion is not None and k in slots:
                found[slots[k]] = squared_distance(x[k] - x_hat, observers.covariance)
            if k % REPORTED == 0:
                report(k)

        def by_level(values: np.ndarray) -> np.ndarray:
            """Of rows (..., rows of all levels) those of each level, (levels, ..., n)."""
            out = np.full((len(LEVELS), *values.shape[:-1], self.runs.y.shape[1]), np.nan)
            at = 0
            for i, each in rows:
                out[i][..., each] = values[..., at : at + len(each)]
                at += len(each)
            return out

        return by_level(found), [np.moveaxis(by_level(each.T), 1, -1) for each in (largest, low, high)]

    def by_knot(self, values: np.ndarray, group: np.ndarray, find: Any) -> np.ndarray:
        """What is found of the values (ages, n, ...) about each knot; where too few are there, of the next knot."""
        known = np.isfinite(values.reshape(*values.shape[:2], -1)).all(-1) & group
        cells = [np.isin(self.ages, span)[:, None] & known for span in self.spans]
        enough = [i for i, cell in enumerate(cells) if cell.sum() >= FEWEST]
        if not enough:
            raise TooFewRunsError(f"fewer than {FEWEST} samples to calibrate on: record more, or hold more out")
        found = {i: find(values[cells[i]]) for i in enough}
        return np.array([found[min(enough, key=lambda j: (abs(i - j), -j))] for i in range(len(cells))])

    def factor(self, distances: np.ndarray) -> float:
        """The factor with which regions of 90 % hold 90 % of the errors."""
        edge = np.quantile(distances, COVERAGE, method="weibull")
        return float(np.clip(edge / chi_square(COVERAGE, self.artifact.nx), 1e-6, 1e6))

    def limits(self, extremes: list[np.ndarray]) -> Limits:
        """Limits that a sound motion exceeds with a sixth of the probability, and of an output's share in it, each."""
        share, sound = self.false_alarms / (6 * self.artifact.ny), self.noisy if self.noisy.any() else ~self.noisy
        largest, low, high = (each[:, sound] for each in extremes)
        mean, above = (MARGIN * np.array([rare(each, share) for each in values]) for values in (largest, high))
        below = np.array([1 / (MARGIN * rare(1 / np.maximum(each, 1e-300), share)) for each in low])
        below[~self.levels.reshape(len(LEVELS), -1).any(-1)] = 0.0
        pace, dt = self.source.pace, self.artifact.filter.dt
        seconds = len(self.runs.u) * dt
        return Limits(self.levels, mean, below, above, WINDOW * pace, WARM_UP * pace, self.false_alarms, seconds)


class Together:
    """An observer whose rows fall into groups of like noise, one group after the other."""

    def __init__(self, artifact: Artifact, groups: Sequence[Group]) -> None:
        self._linear, self._age = artifact.filter, 0
        self._decoders = [decoders(artifact, level, noise) for level, noise, _ in groups]
        self._owner = np.repeat(np.arange(len(groups)), [n for _, _, n in groups])
        self._tracker = None if artifact.motion is None else _Stacked(artifact, groups, self._decoders, self._owner)

    def reset(self, y: np.ndarray) -> np.ndarray:
        """Begin. Shapes: ``y`` (n, ny); returns (n, nx)."""
        self._z, self._y, self._age = self._linear.start(y), y, 0
        if self._tracker is not None:
            self._tracker.reset(y)
        return self._decoded()

    def step(self, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Take in the next samples, all of them present. Shapes: ``u`` (n, nu); returns (n, nx)."""
        if self._tracker is not None:
            self._tracker.advance(y, u)
        self._z, self._y, self._age = self._linear.advance(self._z, self._y, u, y), y, self._age + 1
        return self._decoded()

    @property
    def covariance(self) -> np.ndarray:
        """That of the tracker, (n, nx, nx)."""
        assert self._tracker is not None
        return self._tracker.covariance(self._age)

    def _decoded(self) -> np.ndarray:
        if self._tracker is None:
            age = self._age * self._linear.dt
            parts = [each(self._z[self._owner == i], age) for i, each in enumerate(self._decoders)]
            return np.concatenate(parts)
        self._tracker.supervise(self._z, self._age)
        return self._tracker.estimate


class _Stacked(Tracker):
    """A tracker whose rows have levels of their own."""

    def __init__(self, artifact: Artifact, groups: Sequence[Group], of: Sequence[Decoders], owner: np.ndarray) -> None:
        (level, noise, _), self._each, self._owner = groups[0], of, owner
        super().__init__(artifact, of[0], measurement_noise=level, process_noise=noise)
        q, r = zip(*(self._motion.variances(level, noise) for level, noise, _ in groups), strict=True)
        self._Q, self._R = (np.array([np.diag(one) for one in each])[owner] for each in (q, r))

    @property
    def _machine(self) -> None:
        """NumPy alone: to compile takes as long as a calibration."""

    def _inverted(self, z: np.ndarray, age: np.ndarray, learned: np.ndarray, where: np.ndarray) -> Gaussian:
        x, P = np.empty((len(z), self._motion.nx)), np.empty((len(z), *self._units.shape))
        for i, each in enumerate(self._each):
            mine = self._owner[where] == i
            if mine.any():
                x[mine] = each(z[mine], age[mine])
                P[mine] = each.covariances(z[mine], learned[mine])
        return x, P / self._units


def decoders(artifact: Artifact, level: Level, process_noise: float) -> Decoders:
    """T_inv of the states at levels of noise."""
    return Decoders(artifact, slice(artifact.nx), measurement_noise=level, process_noise=process_noise)


def rare(extremes: np.ndarray, share: float) -> np.ndarray:
    """What a motion's extreme exceeds with a small probability, by a Gumbel distribution of its logarithm.

    Median and 90 % quantile decide, not a few motions that are lost. It is at most ten times the largest extreme, for
    outputs that stand still in most motions. Shapes: ``extremes`` (n, ny); returns (ny,).
    """
    logs = np.log(np.maximum(extremes, np.finfo(float).tiny))
    middle, upper = np.quantile(logs, (0.5, 0.9), axis=0)
    at, half, tenth = (-np.log(-np.log1p(-p)) for p in (share, 0.5, 0.1))
    beyond = middle + (upper - middle) * (at - half) / (tenth - half)
    return np.asarray(np.exp(np.minimum(beyond, logs.max(0) + np.log(10.0))))


def squared_distance(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """e^T P^-1 e, (...,): of Gaussian errors it has the chi-square distribution with nx degrees."""
    scale = np.sqrt(covariance.diagonal(axis1=-2, axis2=-1))  # units may differ by orders of magnitude
    scaled = error / scale
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    return np.asarray((scaled * np.linalg.solve(correlation, scaled[..., None])[..., 0]).sum(-1))


def chi_square(shares: Any, degrees: int) -> np.ndarray:
    """Quantiles of the chi-square distribution, of which scipy.stats has more and takes longer to import."""
    return np.asarray(2 * gammaincinv(degrees / 2, shares))


def _covariance(error: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Mean outer product of errors (n, nx), scaled so that the region of 90 % holds 90 % of them."""
    covariance = error.T @ error / len(error) + least
    edge = np.quantile(squared_distance(error, covariance), COVERAGE, method="weibull")
    return np.asarray(covariance * edge / chi_square(COVERAGE, error.shape[1]))


def _as_level(level: Any) -> Any:
    """A level as observers take it: a number, or one for each output."""
    level = np.asarray(level)
    return tuple(level.tolist()) if level.ndim else float(level)


__all__ = ["calibrate", "chi_square", "squared_distance"]
