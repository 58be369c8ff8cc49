"""The lesson of calibration: covariances and limits of a monitor, from one pass of motions nothing was trained on."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from kkl_gym.system import System
from observers import Artifact, ErrorCovariance, Factors, InverseMap, Limits, Motion
from observers.checks import noise_levels
from observers.decoder import Decoders
from observers.factors import COVERAGE
from observers.tracker import Tracker
from training.config import settings_of
from training.progress import ProgressBars, progress_bars
from training.sources import Runs, Source, TooFewRunsError
from training.sources.simulated import SimulatedSource
from training.trajectories.motions import filter_states

LEVELS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of measurement noise, in multiples of the largest in training
AGES = (0.0, 0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.35, 0.6, 1.0, 2.0, 4.0, 8.0, 16.0)  # seconds at the usual pace
PER_AGE = 6  # samples of each run about each age: at a single one all motions may be in the same phase
FEWEST = 50  # errors from which a covariance or a quantile is taken
LEAST_VARIANCE = 1e-6  # added to that of each state, over its range squared
WINDOW, WARM_UP = 0.5, 5.0  # seconds of the monitor, likewise
REPORTED = 100  # samples from report to report
MARGIN = 1.05  # on limits found among finitely many motions


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
        return _Calibration(artifact, motion or artifact.motion, source, runs, false_alarms).calibrated(progress)


class _Calibration:
    """All levels of noise at once: rows are runs at the first level, the same runs at the second, and so on."""

    def __init__(
        self, artifact: Artifact, motion: Motion | None, source: Source, runs: Runs, false_alarms: float
    ) -> None:
        self.artifact, self.motion, self.source, self.runs = artifact, motion, source, runs
        self.false_alarms, self.dt = false_alarms, artifact.filter.dt
        self.knots, self.spans = _knots(len(runs.u), source.pace / self.dt)
        self.ages = np.unique(np.concatenate(self.spans))
        self.informed = "measurement_noise" in artifact.inverse.features
        largest = (artifact.inverse if self.informed else source.config).measurement_noise_max
        self.levels = np.multiply.outer(LEVELS, largest)
        count, noise = len(LEVELS), np.random.default_rng(0).standard_normal((len(LEVELS), *runs.y.shape))
        y = runs.y + self.levels.reshape(count, 1, 1, -1) * noise
        self.x, self.u = (np.tile(values, (1, count, 1)) for values in (runs.x, runs.u))
        self.y = np.moveaxis(y, 0, 1).reshape(len(y[0]), -1, y.shape[-1])
        process, kind = np.unique(runs.process_noise, return_inverse=True)
        levels = [noise_levels("measurement_noise", level, source.ny) for level in self.levels]
        self.groups = list(itertools.product(levels, process.tolist()))
        self.owner = np.add.outer(len(process) * np.arange(count), kind.ravel()).ravel()
        self.noisy = runs.process_noise > 0

    def calibrated(self, progress: ProgressBars) -> Artifact:
        """The artifact with all tables."""
        replace = dataclasses.replace
        artifact = replace(self.artifact, motion=None, limits=None)
        monitored = artifact.knows_output and self.runs.sound
        if self.informed:
            artifact = self.with_covariances(artifact)
            if self.motion is not None:  # factors are of P as the filter has it
                artifact = replace(artifact, motion=replace(self.motion, factors=Factors.ones()))
        if artifact.motion is None and not monitored:
            return artifact
        with progress.phase("calibrating", len(self.y)) as report:
            distances, extremes = self.followed(artifact, report)
        if artifact.motion is not None:
            groups = (~self.noisy, self.noisy) if self.noisy.any() else (~self.noisy,)
            usual = self.runs.usual
            factors = [[self.by_knot(each, usual & group, self.factor) for each in distances] for group in groups]
            table = Factors(np.array(LEVELS), self.knots * self.dt, np.array(factors))
            artifact = replace(artifact, motion=replace(artifact.motion, factors=table))
        return replace(artifact, limits=self.limits(extremes)) if monitored else artifact

    def by_level(self, values: np.ndarray) -> np.ndarray:
        """Values (m, rows, ...) as (levels, m, n, ...)."""
        return np.moveaxis(values.reshape(len(values), len(LEVELS), -1, *values.shape[2:]), 1, 0)

    def with_covariances(self, artifact: Artifact) -> Artifact:
        """The covariance of T_inv's errors by level and age, of each map."""
        linear, seconds, x = artifact.filter, self.ages * self.dt, self.x[self.ages]
        z = filter_states(linear, self.y, self.u, self.ages)
        x_hat = Rows(artifact, self.groups, self.owner).decode(z, seconds[:, None])
        errors, known = self.by_level(x - x_hat), np.isfinite(self.runs.x[self.ages]).all(-1)
        least = np.diag(LEAST_VARIANCE * np.ptp(self.runs.x[self.ages][known], axis=0) ** 2 + np.finfo(float).tiny)
        moved = np.zeros(known.shape, dtype=bool)
        acted = np.maximum.accumulate((self.runs.u != 0).any(-1), axis=0)
        moved[self.ages > 0] = acted[self.ages[self.ages > 0] - 1]

        def with_table(inverse: InverseMap, group: np.ndarray) -> InverseMap:
            table = [self.by_knot(each, group, lambda e: _covariance(e, least)) for each in errors]
            covariance = ErrorCovariance(np.array(LEVELS), self.knots * self.dt, np.array(table))
            return dataclasses.replace(inverse, error_covariance=covariance)

        if artifact.free_inverse is None:
            return dataclasses.replace(artifact, inverse=with_table(artifact.inverse, known))
        return dataclasses.replace(
            artifact,
            inverse=with_table(artifact.inverse, known & moved),
            free_inverse=with_table(artifact.free_inverse, known & ~moved),
        )

    def followed(self, artifact: Artifact, report: Any) -> tuple[np.ndarray, list[np.ndarray]]:
        """Squared distances (levels, ages, n) of a tracker's errors; extremes (levels, n, ny) of residuals' means."""
        observers, y, pace = Rows(artifact, self.groups, self.owner), self.y, self.source.pace
        share, first = -np.expm1(-self.dt / (WINDOW * pace)), round(WARM_UP * pace / self.dt)
        mean, square = np.zeros_like(y[0]), np.zeros_like(y[0])
        largest, high, low = np.zeros_like(mean), np.zeros_like(mean), np.full_like(mean, np.inf)
        distances = np.full((len(self.ages), y.shape[1]), np.nan)
        slots = {int(age): i for i, age in enumerate(self.ages)}
        for k in range(len(y)):
            x_hat = observers.reset(y[0]) if k == 0 else observers.step(y[k], self.u[k - 1])
            if artifact.knows_output:
                residual = artifact.residual(y[k], x_hat)
                mean += share * (residual - mean)
                square += share * (residual**2 - square)
                if k > first:
                    largest, high = np.maximum(largest, np.abs(mean)), np.maximum(high, square)
                    low = np.minimum(low, square)
            if artifact.motion is not None and k in slots:
                distances[slots[k]] = squared_distance(self.x[k] - x_hat, observers.covariance)
            if k % REPORTED == 0:
                report(k)
        return self.by_level(distances), [self.by_level(each[None])[:, 0] for each in (largest, low, high)]

    def by_knot(self, values: np.ndarray, group: np.ndarray, find: Any) -> np.ndarray:
        """A function of the values (ages, n, ...) about each knot; where these are too few, that of the next knot."""
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
        pace, seconds = self.source.pace, len(self.u) * self.dt
        return Limits(self.levels, mean, below, above, WINDOW * pace, WARM_UP * pace, self.false_alarms, seconds)


class Rows:
    """An observer whose rows belong to groups, each with a level of measurement and of process noise of its own."""

    def __init__(self, artifact: Artifact, groups: Sequence[tuple[Any, float]], owner: np.ndarray) -> None:
        self._linear, self._nx, self._age, self._owner = artifact.filter, artifact.nx, 0, owner
        self._decoders = [
            Decoders(artifact, slice(artifact.nx), measurement_noise=level, process_noise=noise)
            for level, noise in groups
        ]
        self._tracker = None if artifact.motion is None else _Stacked(artifact, groups, self._decoders, owner)

    def reset(self, y: np.ndarray) -> np.ndarray:
        """Begin. Shapes: ``y`` (n, ny); returns (n, nx)."""
        self._z, self._y, self._age = self._linear.start(y), y, 0
        if self._tracker is not None:
            self._rows = self._tracker.begin(y)
        return self._estimate()

    def step(self, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Take in the next samples, all of them present. Shapes: ``u`` (n, nu); returns (n, nx)."""
        if self._tracker is not None:
            self._rows, _ = self._tracker.advance(self._rows, y, u)
        self._z, self._y, self._age = self._linear.advance(self._z, self._y, u, y), y, self._age + 1
        return self._estimate()

    @property
    def covariance(self) -> np.ndarray:
        """That of the tracker, (n, nx, nx)."""
        assert self._tracker is not None
        return self._tracker.covariance(self._rows, np.full(len(self._z), float(self._age)))

    def decode(self, z: np.ndarray, age: Any) -> np.ndarray:
        """T_inv of filter states (..., n, size) at ages in seconds, (..., n, nx)."""
        x_hat = np.empty((*z.shape[:-1], self._nx))
        for i, each in enumerate(self._decoders):
            mine = self._owner == i
            x_hat[..., mine, :] = each(z[..., mine, :], age)
        return x_hat

    def _estimate(self) -> np.ndarray:
        if self._tracker is None:
            return self.decode(self._z, self._age * self._linear.dt)
        self._rows = self._tracker.supervise(self._rows, self._z, np.full(len(self._z), float(self._age)))
        return self._rows[:, self._tracker.x]


class _Stacked(Tracker):
    """A tracker whose rows have levels of their own."""

    def __init__(
        self,
        artifact: Artifact,
        groups: Sequence[tuple[Any, float]],
        decoders: Sequence[Decoders],
        owner: np.ndarray,
    ) -> None:
        (level, noise), self._each, self._owner = groups[0], decoders, owner
        super().__init__(artifact, decoders[0], measurement_noise=level, process_noise=noise)
        q, r = zip(*(self.motion.variances(*group) for group in groups), strict=True)
        q = [each * self.motion.x_scale**2 for each in q]
        self._Q, self._R = (np.array([np.diag(one) for one in each])[owner] for each in (q, r))

    def _decoded(self, of: Any, z: np.ndarray, age: np.ndarray, where: np.ndarray) -> np.ndarray:
        owner = self._owner[where]
        parts = {i: of(self._each[i], z[owner == i], age[owner == i]) for i in np.unique(owner)}
        values = np.empty((len(z), *next(iter(parts.values())).shape[1:]))
        for i, part in parts.items():
            values[owner == i] = part
        return values


def _knots(steps: int, pace: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Ages in samples at which tables have entries, and for each of these those that are looked at about it."""
    last = max(1, min(4 * steps // 5, round(AGES[-1] * pace)))
    knots = np.array(sorted({k for k in (round(age * pace) for age in AGES) if k < last} | {last}))
    between = np.sqrt(knots[1:] * np.maximum(knots[:-1], 0.5))
    edges = [0.0, *between.tolist(), float(steps)]
    counts = [PER_AGE] * len(between) + [4 * PER_AGE]
    spans = (np.linspace(low, high, count) for low, high, count in zip(edges, edges[1:], counts, strict=False))
    return knots, [np.unique(span.round()).astype(int) for span in spans]


def rare(extremes: np.ndarray, share: float) -> np.ndarray:
    """Value that a motion's extreme exceeds with a small probability, by a Gumbel distribution of its logarithm.

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


__all__ = ["calibrate", "chi_square", "squared_distance"]
