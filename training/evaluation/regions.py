"""Factors by which regions of 90 % hold 90 % of an observer's errors, at each age and level of noise."""

from dataclasses import dataclass

import numpy as np

from kkl_gym.system import System
from observers import Artifact
from observers.factors import COVERAGE
from training.evaluation.metrics import chi_square

# Of measurement noise, in multiples of the largest that the map is told; dense near 0, where errors of the map end.
LEVELS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
FIRST = (0, 1, 3, 8)  # ages in samples at which factors are found
AGES = (0.15, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # the same in seconds, at the pace of the shipped systems
LENIENT = 0.92  # share that regions of 90 % may hold, where fewer would leave the mean NEES above what it should be
FEWEST = 50  # errors from which a quantile is taken
PER_AGE = 6  # samples of each run about each age: at a single one all motions may be in the same phase


@dataclass(frozen=True)
class Regions:
    """Where along runs errors are looked at.

    Parameters
    ----------
    knots : ndarray of int, shape (m,)
        Ages in samples at which there are factors, rising from 0.
    steps : int
        Length of the runs in samples.
    nx : int
        Number of states.
    """

    knots: np.ndarray
    steps: int
    nx: int

    @classmethod
    def of(cls, artifact: Artifact, system: System, duration: float) -> "Regions":
        """Those of an observer of a system, on runs of so many seconds."""
        dt, settled = artifact.filter.dt, min(artifact.inverse.age_max, duration / 2)
        later = [round(age * system.pace / dt) for age in AGES]
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

    def factors(self, distances: list[np.ndarray], group: np.ndarray, *, lenient: bool = False) -> np.ndarray:
        """Find factors from errors.

        Parameters
        ----------
        distances : list of ndarray, shape (ages, n) each
            Squared distances of errors in units of their covariance, for each of ``LEVELS``, at :attr:`ages`.
        group : ndarray of bool, shape (ages, n)
            Which of them count.
        lenient : bool
            Whether regions of 90 % may hold up to 92 %, as far as that brings the mean squared distance to nx: for
            errors whose tails are longer than those of a normal distribution.

        Returns
        -------
        ndarray, shape (levels, knots)
            The factors.

        Raises
        ------
        ValueError
            If hardly any count.
        """
        rows, inside = [np.isin(self.ages, window) for window in self._windows()], chi_square(COVERAGE, self.nx)
        factors = np.empty(self.tables)
        for i, distance in enumerate(distances):
            for j, row in enumerate(rows):
                found = distance[row][group[row]]
                if len(found) < FEWEST:  # as of driven motions at the first sample: those of the next age count
                    factors[i, j] = np.nan
                    continue
                edge, most = np.quantile(found, (COVERAGE, LENIENT), method="weibull")
                factors[i, j] = np.clip(inside * found.mean() / self.nx, edge, most) if lenient else edge
            known = np.isfinite(factors[i])
            if not known.any():
                raise ValueError("hardly any motion is of the kind that error bars are for; simulate more trajectories")
            factors[i] = np.interp(np.arange(len(rows)), np.flatnonzero(known), factors[i, known])
        return np.clip(factors / inside, 1e-6, 1e6)

    def _windows(self) -> list[np.ndarray]:
        """Ages in samples that stand for each of the knots: those about it, and all behind the last."""
        between = np.sqrt(self.knots[1:] * np.maximum(self.knots[:-1], 0.5))
        edges = [0.0, *between.tolist(), float(self.steps)]
        counts = [PER_AGE] * len(between) + [4 * PER_AGE]
        spans = (np.linspace(low, high, count) for low, high, count in zip(edges, edges[1:], counts, strict=False))
        return [np.unique(span.round()).astype(int) for span in spans]


def level_of(artifact: Artifact, share: float) -> float | tuple[float, ...]:
    """A level of measurement noise, in multiples of the largest that the map is told, as observers take it."""
    level = share * np.asarray(artifact.inverse.measurement_noise_max)
    return tuple(level.tolist()) if level.ndim else float(level)
