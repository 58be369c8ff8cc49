"""Factors by which regions of 90 % hold 90 % of an observer's errors, at each age and level of noise."""

import copy
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from observers import Artifact, KKLObserver
from observers.factors import COVERAGE

# Of measurement noise, in multiples of the largest that the map is told; dense near 0, where errors of the map end.
LEVELS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
FIRST = (0, 1, 3, 8)  # ages in samples at which factors are found
AGES = (0.15, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # the same in seconds, at the pace of the shipped systems
LENIENT = 0.91  # share that regions of 90 % may hold, where fewer would leave the mean NEES above what it should be
RUNS = 100  # motions over which this mean is taken, as those do who test it; of several hundreds the median counts
DOUBTS = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3)  # of covariances, which are tried
FEWEST = 50  # errors from which a quantile is taken
PER_AGE = 6  # samples of each run about each age: at a single one all motions may be in the same phase


@dataclass(frozen=True)
class Errors:
    """Errors (ages, n, nx) of an observer that tracks, and what it says of them."""

    error: np.ndarray
    covariance: np.ndarray
    in_doubt: np.ndarray


@dataclass(frozen=True)
class Regions:
    """Where along runs errors are looked at. Shapes: ``knots`` (m,)."""

    knots: np.ndarray
    steps: int
    nx: int

    @classmethod
    def of(cls, artifact: Artifact, duration: float, *, pace: float) -> "Regions":
        """Those of an observer on runs of so many seconds, of a plant that takes ``pace`` times as long as ours."""
        dt, settled = artifact.filter.dt, min(artifact.inverse.age_max, duration / 2)
        later = [round(age * pace / dt) for age in AGES]
        last = max(1, round(settled / dt))
        knots = np.array(sorted({*(k for k in (*FIRST, *later) if k < last), last}))
        return cls(knots, round(duration / dt), artifact.nx)

    @property
    def ages(self) -> np.ndarray:
        """Samples of runs at which errors are to be known, sorted."""
        return np.unique(np.concatenate(self._windows()))

    @property
    def tables(self) -> tuple[int, int]:
        """Shape of a table of factors."""
        return len(LEVELS), len(self.knots)

    def factors(self, distances: list[np.ndarray], group: np.ndarray) -> np.ndarray:
        """Find factors (levels, knots) from squared distances (ages, n) of errors."""
        return self._table(group, lambda i, cell: [self._factor(distances[i][cell], COVERAGE)])[..., 0]

    def factors_and_doubts(self, errors: list["Errors"], group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find how far covariances are to be doubted, so that usual errors are likeliest, and factors.

        These are lenient: regions of 90 % may hold up to 91 %, as far as that brings the mean squared distance to nx.
        A tracker's errors have longer tails than a normal distribution's. So the mean is what a hundred motions usually
        show: a few that are lost would make up most of the mean of all.

        Shapes: ``group`` (ages, n); returns ``factors, doubts`` (levels, knots).
        """
        found = self._table(group, lambda i, cell: self._likeliest(errors[i], cell))
        return found[..., 0], found[..., 1]

    def _table(self, group: np.ndarray, found: Callable[[int, np.ndarray], Sequence[float]]) -> np.ndarray:
        """What is found of the errors about each knot at each level, (levels, knots, ...).

        As of driven motions at the first sample there may be too few: those of the next age count.
        """
        cells = [group & np.isin(self.ages, window)[:, None] for window in self._windows()]
        enough = np.flatnonzero([cell.sum() >= FEWEST for cell in cells])
        if not len(enough):
            raise ValueError("hardly any motion is of the kind that error bars are for; simulate more trajectories")
        tables = []
        for level in range(len(LEVELS)):
            columns = np.array([found(level, cells[knot]) for knot in enough]).T
            tables.append([np.interp(np.arange(len(cells)), enough, column) for column in columns])
        return np.moveaxis(np.array(tables), 1, -1)

    def _factor(self, distances: np.ndarray, share: float) -> float:
        """With it regions of 90 % hold a share of the errors."""
        edge = np.quantile(distances, share, method="weibull")
        return float(np.clip(edge / chi_square(COVERAGE, self.nx), 1e-6, 1e6))

    def _likeliest(self, errors: "Errors", cell: np.ndarray) -> tuple[float, float]:
        """The factor and the doubt with which errors of a cell are likeliest."""
        error, P, other = errors.error[cell], errors.covariance[cell], errors.in_doubt[cell]
        motion, tried = np.nonzero(cell)[1], []
        for doubt in DOUBTS:
            mixed = P + doubt * (other - P)
            distances = squared_distance(error, mixed)
            mean = usual_mean(distances, motion)
            least, most = (self._factor(distances, share) for share in (COVERAGE, LENIENT))
            factor = float(np.clip(mean / self.nx, least, most))
            surprise = mean / factor + np.linalg.slogdet(mixed)[1].mean() + self.nx * np.log(factor)
            tried.append((surprise, factor, doubt))
        return min(tried)[1:]

    def _windows(self) -> list[np.ndarray]:
        """Ages in samples that stand for each of the knots: those about it, and all behind the last."""
        between = np.sqrt(self.knots[1:] * np.maximum(self.knots[:-1], 0.5))
        edges = [0.0, *between.tolist(), float(self.steps)]
        counts = [PER_AGE] * len(between) + [4 * PER_AGE]
        spans = (np.linspace(low, high, count) for low, high, count in zip(edges, edges[1:], counts, strict=False))
        return [np.unique(span.round()).astype(int) for span in spans]


def usual_mean(values: np.ndarray, motion: np.ndarray) -> float:
    """The mean of values along motions, as ``RUNS`` motions usually show it: the median of such means."""
    motions, motion = np.unique(motion, return_inverse=True)
    groups = max(1, len(motions) // RUNS)
    of = motion % groups
    return float(np.median(np.bincount(of, values) / np.bincount(of)))


def level_of(artifact: Artifact, share: float) -> float | tuple[float, ...]:
    """A level of measurement noise, in multiples of the largest that the map is told, as observers take it."""
    level = share * np.asarray(artifact.inverse.measurement_noise_max)
    return tuple(level.tolist()) if level.ndim else float(level)


def distances_along(
    artifact: Artifact,
    x: np.ndarray,
    y: np.ndarray,
    u: np.ndarray,
    *,
    level: float | tuple[float, ...],
    ages: np.ndarray,
) -> np.ndarray:
    """Run an observer from its reset on; squared distances (ages, n) of its errors in its own covariances."""
    observer = KKLObserver(artifact, level)
    return np.array(
        [squared_distance(x[k] - observer.decode(), observer.covariance) for k in _at(observer, y, u, ages)]
    )


def errors_along(
    artifact: Artifact,
    x: np.ndarray,
    y: np.ndarray,
    u: np.ndarray,
    *,
    level: float | tuple[float, ...],
    process_noise: float | None = None,
    ages: np.ndarray,
) -> Errors:
    """Run an observer that tracks, with factors of 1, from its reset on."""
    observer, doubting = KKLObserver(artifact, level, process_noise=process_noise), _in_doubt(artifact)
    found = []
    for k in _at(observer, y, u, ages):
        other = copy.copy(observer)
        other.replace(doubting)
        found.append((x[k] - observer.decode(), observer.covariance, other.covariance))
    return Errors(*map(np.array, zip(*found, strict=True)))


def _in_doubt(artifact: Artifact) -> Artifact:
    """The same with a doubt of 1 everywhere."""
    flow = artifact.require_flow()
    return dataclasses.replace(
        artifact,
        flow=dataclasses.replace(
            flow, factors=dataclasses.replace(flow.factors, doubt=np.ones_like(flow.factors.factors)), free_factors=None
        ),
    )


def _at(observer: KKLObserver, y: np.ndarray, u: np.ndarray, ages: np.ndarray) -> Iterator[int]:
    """Run an observer, and stop at some ages, whose samples are yielded."""
    observer.reset(y[0])
    for k in range(int(ages[-1]) + 1):
        if k:
            observer.advance(y[k], u[k - 1] if observer.artifact.nu else None)
        if k in ages:
            yield k


def squared_distance(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """e^T P^-1 e, (...,): of Gaussian errors it has the chi-square distribution with nx degrees."""
    scale = np.sqrt(covariance.diagonal(axis1=-2, axis2=-1))  # units may differ by orders of magnitude
    scaled = error / scale
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    return np.asarray((scaled * np.linalg.solve(correlation, scaled[..., None])[..., 0]).sum(-1))


def chi_square(shares: float | Sequence[float], degrees: int) -> np.ndarray:
    """Quantiles of the chi-square distribution, of which scipy.stats has more and takes longer to import."""
    return np.asarray(2 * gammaincinv(degrees / 2, shares))
