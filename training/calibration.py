"""Calibration of an observer's error covariances and of its monitor's limits, on motions that no training used."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from kkl_gym.system import System
from observers import Artifact, ErrorCovariance, Factors, InverseMap, KKLObserver, Limits, Motion
from observers.checks import noise_levels
from observers.decoder import Decoders
from observers.factors import COVERAGE
from training.config import settings_of
from training.progress import ProgressBars, progress_bars
from training.sources import Runs, Source, TooFewRunsError
from training.sources.simulated import SimulatedSource
from training.trajectories.motions import filter_states

LEVELS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # measurement noise, in multiples of the largest level in training
# Times since reset, in units of the source's ``pace``.
AGES = (0.0, 0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.35, 0.6, 1.0, 2.0, 4.0, 8.0, 16.0)
# Samples of a run around each age (at the last, four times as many). One would not do, as motions may be in phase.
PER_AGE = 6
FEWEST = 50  # least number of errors for a covariance or a quantile
LEAST_VARIANCE = 1e-6  # added to the variance of each state's error, as a fraction of the state's squared range
WINDOW, WARM_UP = 0.5, 5.0  # the monitor's averaging window and its warm-up, in units of the pace
MARGIN = 1.05  # factor on the limits, because only finitely many motions determine them


def calibrate(
    artifact: Artifact,
    source: Source | System,
    *,
    motion: Motion | None = None,
    false_alarms: float | None = None,
    console: Any = None,
) -> Artifact:
    """Estimate the covariances of an observer's errors and the limits of its monitor.

    The observer runs from a reset along motions that no training used, at several levels of measurement noise. Its
    errors determine two tables by noise level and time since reset: the covariance of T_inv's error, and a factor on
    the tracker's covariance. Its residuals y - h(x_hat) determine the limits beyond which the monitor assumes a fault.

    Parameters
    ----------
    artifact : Artifact
        The observer to calibrate.
    source : Source or System
        The source or system that the observer was trained for.
    motion : Motion, optional
        The tracker's motion model; by default that of ``artifact``, if any.
    false_alarms : float, optional
        Probability that a fault-free motion exceeds a limit, over the length of the calibration motions (20 times
        ``System.pace`` for a system); by default the probability in the settings of the observer's training.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown; by default nowhere.

    Returns
    -------
    Artifact
        A copy of the observer with covariances and limits.

    Raises
    ------
    ValueError
        If ``false_alarms`` is not between 0 and 1, almost all motions leave the system's bounds, or too few motions are
        held out; :class:`observers.ArtifactError` (a ValueError) if the observer was made for another system.
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
        raise ValueError(f"the source has (nx, ny, nu) = {sizes}, but the observer has {expected}")
    with progress_bars(console) as progress:
        with progress.phase("motions for calibration") as report:
            runs = source.runs(report=report)
        return _Calibration(artifact, source, runs, false_alarms).calibrated(motion or artifact.motion, progress)


class _Calibration:
    """Calibrates an observer on a set of runs, to whose outputs it adds each level of measurement noise in turn."""

    def __init__(self, artifact: Artifact, source: Source, runs: Runs, false_alarms: float) -> None:
        self.artifact, self.source, self.runs, self.false_alarms = artifact, source, runs, false_alarms
        self.dt, self.noisy = artifact.filter.dt, runs.process_noise > 0
        self.knots, self.spans = _knots(len(runs.u), source.pace / self.dt)
        self.ages = np.unique(np.concatenate(self.spans))
        self.informed = "measurement_noise" in artifact.inverse.features
        largest = (artifact.inverse if self.informed else source.config).measurement_noise_max
        self.levels = np.multiply.outer(LEVELS, largest)

    def calibrated(self, motion: Motion | None, progress: ProgressBars) -> Artifact:
        """Return the artifact with covariances, a motion model and limits, as far as it can have each of these."""
        artifact = replace(self.artifact, motion=None, limits=None)
        monitored = artifact.knows_output and self.runs.sound
        if self.informed:
            artifact = self.with_covariances(artifact)
            if motion is not None:  # factors of 1 leave the tracker's covariance as it is
                artifact = replace(artifact, motion=replace(motion, factors=Factors.ones()))
        if artifact.motion is None and not monitored:
            return artifact
        with progress.phase("calibrating", len(LEVELS)) as report:
            distances, extremes = self.followed(artifact, report)
        if artifact.motion is not None:
            groups = (~self.noisy, self.noisy) if self.noisy.any() else (~self.noisy,)
            usual = self.runs.usual
            find = partial(_excess, degrees=artifact.nx)
            factors = [[self.by_knot(each, usual & group, find) for each in distances] for group in groups]
            table = Factors(np.array(LEVELS), self.knots * self.dt, np.clip(factors, 1e-6, 1e6))
            artifact = replace(artifact, motion=replace(artifact.motion, factors=table))
        return replace(artifact, limits=self.limits(extremes)) if monitored else artifact

    def groups(self) -> Iterator[tuple[int, dict[str, Any], np.ndarray, np.ndarray, np.ndarray]]:
        """Yield (index in ``LEVELS``, both noise levels, mask (n,) of runs with this process noise, their y and u)."""
        runs, rng = self.runs, np.random.default_rng(0)
        for i, level in enumerate(self.levels):
            y = runs.y + level * rng.standard_normal(runs.y.shape)
            measurement_noise = noise_levels("measurement_noise", level, self.source.ny)
            for noise in np.unique(runs.process_noise).tolist():
                rows = runs.process_noise == noise
                levels = {"measurement_noise": measurement_noise, "process_noise": noise}
                yield i, levels, rows, y[:, rows], runs.u[:, rows]

    def with_covariances(self, artifact: Artifact) -> Artifact:
        """Return the artifact with an error covariance, by noise level and age, in each of its inverse maps."""
        seconds, x = self.ages * self.dt, self.runs.x[self.ages]
        errors, finite = np.empty((len(LEVELS), *x.shape)), np.isfinite(x).all(-1)
        for i, levels, rows, y, u in self.groups():
            T_inv, z = Decoders(artifact, slice(artifact.nx), **levels), filter_states(artifact.filter, y, u, self.ages)
            errors[i][:, rows] = x[:, rows] - T_inv(z, seconds[:, None])
        least = np.diag(LEAST_VARIANCE * np.ptp(x[finite], axis=0) ** 2 + np.finfo(float).tiny)
        acted = np.maximum.accumulate((self.runs.u != 0).any(-1), axis=0)
        moved = np.concatenate([np.zeros_like(acted[:1]), acted])[self.ages]

        def with_table(inverse: InverseMap, group: np.ndarray) -> InverseMap:
            table = [self.by_knot(each, group, lambda e: _covariance(e, least)) for each in errors]
            covariance = ErrorCovariance(np.array(LEVELS), self.knots * self.dt, np.array(table))
            return replace(inverse, error_covariance=covariance)

        free = artifact.free_inverse
        if free is not None:  # the observer uses this map until an input acts
            free, finite = with_table(free, finite & ~moved), finite & moved
        return replace(artifact, inverse=with_table(artifact.inverse, finite), free_inverse=free)

    def followed(self, artifact: Artifact, report: Any) -> tuple[np.ndarray, np.ndarray]:
        """Run the observer; return errors' squared Mahalanobis distances (levels, ages, n) and residuals' extremes."""
        from scipy.signal import lfilter  # takes half a second to import

        runs, pace = self.runs, self.source.pace
        distances = np.full((len(LEVELS), len(self.ages), runs.x.shape[1]), np.nan)
        extremes = np.zeros((3, len(LEVELS), *runs.y.shape[1:]))  # largest |mean|, least and largest mean square
        share, first = -np.expm1(-self.dt / (WINDOW * pace)), 1 + round(WARM_UP * pace / self.dt)
        slots = {int(age): i for i, age in enumerate(self.ages)}
        for i, levels, rows, y, u in self.groups():
            report(i)
            observer, x = KKLObserver(artifact, **levels), runs.x[:, rows]
            x_hat = np.empty_like(x)
            for k in range(len(y)):
                x_hat[k] = observer.step(y[k], u[k - 1]) if k else observer.reset(y[0])
                if artifact.motion is not None and k in slots:
                    distances[i, slots[k], rows] = squared_distance(x[k] - x_hat[k], observer.covariance)
            if artifact.knows_output:
                residual = artifact.residual(y, x_hat)
                mean, square = (lfilter([share], [1, share - 1], r, 0)[first:] for r in (residual, residual**2))
                largest, high = np.abs(mean).max(0, initial=0.0), square.max(0, initial=0.0)
                extremes[:, i, rows] = largest, square.min(0, initial=np.inf), high
        return distances, extremes

    def by_knot(self, values: np.ndarray, group: np.ndarray, find: Any) -> np.ndarray:
        """Apply ``find`` to the values (ages, n, ...) near each knot; if they are too few, copy the closest result."""
        finite = np.isfinite(values.reshape(*values.shape[:2], -1)).all(-1) & group
        cells = [np.isin(self.ages, span)[:, None] & finite for span in self.spans]
        enough = [i for i, cell in enumerate(cells) if cell.sum() >= FEWEST]
        if not enough:
            raise TooFewRunsError(f"fewer than {FEWEST} samples to calibrate on: record, hold out or simulate more")
        entries = {i: find(values[cells[i]]) for i in enough}
        return np.array([entries[min(enough, key=lambda j: (abs(i - j), -j))] for i in range(len(cells))])

    def limits(self, extremes: np.ndarray) -> Limits:
        """Return 3 ny limits by level; a fault-free run crosses at least one with probability <= false_alarms / 2."""
        share, sound = self.false_alarms / (6 * self.artifact.ny), self.noisy if self.noisy.any() else ~self.noisy
        largest, low, high = extremes[:, :, sound]
        mean, above = (MARGIN * np.array([rare(each, share) for each in values]) for values in (largest, high))
        below = np.array([1 / (MARGIN * rare(1 / np.maximum(each, 1e-300), share)) for each in low])
        below[~self.levels.reshape(len(LEVELS), -1).any(-1)] = 0.0
        pace, seconds = self.source.pace, len(self.runs.u) * self.dt
        return Limits(self.levels, mean, below, above, WINDOW * pace, WARM_UP * pace, self.false_alarms, seconds)


def _knots(steps: int, pace: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the knots (ages in samples at which tables have entries), and the ages that contribute to each knot."""
    last = max(1, min(4 * steps // 5, round(AGES[-1] * pace)))
    knots = np.array(sorted({k for k in (round(age * pace) for age in AGES) if k < last} | {last}))
    between = np.sqrt(knots[1:] * np.maximum(knots[:-1], 0.5))
    edges = [0.0, *between.tolist(), float(steps)]
    counts = [PER_AGE] * len(between) + [4 * PER_AGE]
    spans = (np.linspace(low, high, count) for low, high, count in zip(edges, edges[1:], counts, strict=False))
    return knots, [np.unique(span.round()).astype(int) for span in spans]


def rare(extremes: np.ndarray, share: float) -> np.ndarray:
    """Estimate the values (ny,) that ``extremes`` (n, ny) of motions exceed with probability ``share``.

    A Gumbel distribution is fitted to the logarithms by the median and the 90 % quantile, which a few huge extremes do
    not change. The values are at most ten times the largest extreme: if y rarely moves, the fit may lie far higher.
    """
    logs = np.log(np.maximum(extremes, np.finfo(float).tiny))
    middle, upper = np.quantile(logs, (0.5, 0.9), axis=0)
    at, half, tenth = (-np.log(-np.log1p(-p)) for p in (share, 0.5, 0.1))
    beyond = middle + (upper - middle) * (at - half) / (tenth - half)
    return np.asarray(np.exp(np.minimum(beyond, logs.max(0) + np.log(10.0))))


def squared_distance(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the squared Mahalanobis distances e^T P^-1 e (...,), which are chi-square for Gaussian errors."""
    scale = np.sqrt(covariance.diagonal(axis1=-2, axis2=-1))  # the states' sizes may differ by orders of magnitude
    scaled = error / scale
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    return np.asarray((scaled * np.linalg.solve(correlation, scaled[..., None])[..., 0]).sum(-1))


def chi_square(shares: Any, degrees: int) -> np.ndarray:
    """Return quantiles of the chi-square distribution; scipy.stats has them too, but takes longer to import."""
    return np.asarray(2 * gammaincinv(degrees / 2, shares))


def _covariance(error: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Return the mean outer product of errors (n, nx), scaled so that its 90 % region holds 90 % of the errors."""
    covariance = error.T @ error / len(error) + least
    return np.asarray(covariance * _excess(squared_distance(error, covariance), error.shape[1]))


def _excess(distances: np.ndarray, degrees: int) -> float:
    """Return the 90 % quantile of squared distances, divided by that of the chi-square distribution."""
    return float(np.quantile(distances, COVERAGE, method="weibull") / chi_square(COVERAGE, degrees))
