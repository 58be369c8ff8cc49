"""What covariances are multiplied with, so that regions of 90 % hold 90 % of the errors."""

from dataclasses import dataclass

import numpy as np

from observers.checks import shown

COVERAGE = 0.9  # of the regions that the factors make true
_LARGEST = 1e12


@dataclass(frozen=True)
class Factors:
    """Factors by level of measurement noise, age, and process noise, found on runs that nothing else was fitted to.

    With them, nine errors in ten lie where (x - x_hat)^T P^-1 (x - x_hat) is below the 90 % quantile of the chi-square
    distribution with nx degrees of freedom. Between levels and ages their logarithms are interpolated, and beyond the
    last ones they stay.

    Parameters
    ----------
    levels : ndarray, shape (k,)
        Levels of measurement noise, rising from 0, in multiples of the largest that the map is told.
    ages : ndarray, shape (m,)
        Seconds since reset, rising from 0.
    factors : ndarray, shape (k, m) or (2, k, m)
        At each of them; two tables are without process noise and with the highest level that the map is told.
    doubt : ndarray, shape as the factors', optional
        How far the covariance itself is doubted, from 0, which is meant by default, to 1. What takes its place so far
        is up to who asks; :class:`observers.tracker.Tracker` does.

    Raises
    ------
    ValueError
        If shapes do not go together, levels or ages do not rise from 0, a factor is not positive, or a doubt is not
        within 0 and 1.
    """

    levels: np.ndarray
    ages: np.ndarray
    factors: np.ndarray
    doubt: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("levels", "ages"):
            values = getattr(self, name)
            rising = values.ndim == 1 and len(values) and values[0] == 0 and (np.diff(values) > 0).all()
            if not rising or not np.isfinite(values).all():
                raise ValueError(f"the {name} of error bars must rise from 0, got {shown(values)}")
        tables = (len(self.levels), len(self.ages))
        if self.factors.shape not in (tables, (2, *tables)):
            raise ValueError(
                f"factors of shape {self.factors.shape} do not fit {tables[0]} levels and {tables[1]} ages"
            )
        if not ((self.factors > 0) & (self.factors <= _LARGEST)).all():
            raise ValueError(f"factors must be positive and at most {_LARGEST:g}, got {shown(self.factors)}")
        if self.doubt is None:
            return
        if self.doubt.shape != self.factors.shape:
            raise ValueError(f"doubt of shape {self.doubt.shape} does not fit factors of shape {self.factors.shape}")
        if not ((self.doubt >= 0) & (self.doubt <= 1)).all():
            raise ValueError(f"doubt must be within 0 and 1, got {shown(self.doubt)}")

    def log_roots(self, measurement_noise: float, process_noise: float) -> np.ndarray:
        """Logarithms of the factors' square roots at each age.

        Parameters
        ----------
        measurement_noise, process_noise : float
            Levels in multiples of the highest that the map is told.

        Returns
        -------
        ndarray, shape (m,)
            What logarithms of standard deviations rise by.
        """
        return self._by_age(np.log(self.factors) / 2, measurement_noise, process_noise)

    def doubts(self, measurement_noise: float, process_noise: float) -> np.ndarray:
        """How far the covariance is doubted at each age, shape (m,), at levels as :meth:`log_roots` takes them."""
        doubt = np.zeros_like(self.factors) if self.doubt is None else self.doubt
        return self._by_age(doubt, measurement_noise, process_noise)

    def _by_age(self, tables: np.ndarray, measurement_noise: float, process_noise: float) -> np.ndarray:
        if tables.ndim == 3:
            share = min(process_noise, 1.0)
            tables = (1.0 - share) * tables[0] + share * tables[1]
        return np.array([np.interp(measurement_noise, self.levels, column) for column in tables.T])


__all__ = ["COVERAGE", "Factors"]
