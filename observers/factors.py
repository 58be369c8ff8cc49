"""Calibrated error covariances, by age (time since reset) and level of measurement noise."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from observers.checks import ArtifactError, shown

COVERAGE = 0.9  # share of errors inside the calibrated regions
_MAX_FACTOR = 1e12  # largest calibration factor


def _check_grid(levels: np.ndarray, ages: np.ndarray) -> tuple[int, int]:
    """Return the numbers of levels and ages, or raise ArtifactError unless both rise from 0."""
    for name, values in (("levels", levels), ("ages", ages)):
        rising = values.ndim == 1 and len(values) and values[0] == 0 and (np.diff(values) > 0).all()
        if not rising or not np.isfinite(values).all():
            raise ArtifactError(f"the {name} of a covariance must rise from 0, got {shown(values)}")
    return len(levels), len(ages)


@dataclass(frozen=True)
class Factors:
    """Calibration factors of a Kalman filter's covariance P. Raises ArtifactError if they are invalid.

    After P is multiplied by its factor, 90 % of errors have (x - x_hat)^T P^-1 (x - x_hat) below the 90 % quantile of
    chi-square with nx degrees of freedom. Between levels and ages, factors are interpolated; beyond, they are constant.

    Parameters
    ----------
    levels : ndarray, shape (k,)
        Levels of measurement noise, rising from 0, in multiples of the largest in the map's training.
    ages : ndarray, shape (m,)
        Seconds since reset, rising from 0.
    factors : ndarray, shape (2, k, m) or (1, k, m)
        Positive factors: [0] without process noise, [1] at its largest level in training; a single [0] holds for both.
    """

    levels: np.ndarray
    ages: np.ndarray
    factors: np.ndarray

    def __post_init__(self) -> None:
        sizes = _check_grid(self.levels, self.ages)
        if self.factors.ndim != 3 or len(self.factors) not in (1, 2) or self.factors.shape[1:] != sizes:
            raise ArtifactError(f"factors of shape {self.factors.shape} do not fit {sizes[0]} levels, {sizes[1]} ages")
        if not ((self.factors > 0) & (self.factors <= _MAX_FACTOR)).all():
            raise ArtifactError(f"factors must be positive and at most {_MAX_FACTOR:g}, got {shown(self.factors)}")

    @classmethod
    def ones(cls) -> Self:
        """Return factors of 1, for use before calibration."""
        return cls(np.zeros(1), np.zeros(1), np.ones((1, 1, 1)))

    def at_levels(self, measurement_noise: float, process_noise: float) -> np.ndarray:
        """Return the factors (m,) at noise levels, which are in multiples of the largest levels in training."""
        share = min(process_noise, 1.0)
        table = (1.0 - share) * self.factors[0] + share * self.factors[-1]
        return interpolated(measurement_noise, self.levels, table)


@dataclass(frozen=True)
class ErrorCovariance:
    """The covariance of x - T_inv(z), by level of measurement noise and age since reset.

    It is calibrated like the covariance in :class:`Factors`. Raises ArtifactError if it is invalid.

    Parameters
    ----------
    levels, ages : ndarray, shapes (k,) and (m,)
        As for :class:`Factors`.
    covariance : ndarray, shape (k, m, nx, nx)
        Covariances in units of the states, positive definite.
    """

    levels: np.ndarray
    ages: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        sizes = _check_grid(self.levels, self.ages)
        shape = self.covariance.shape
        if len(shape) != 4 or shape[:2] != sizes or shape[2] != shape[3] or not shape[2]:
            raise ArtifactError(f"covariances of shape {shape} do not fit {sizes[0]} levels and {sizes[1]} ages")
        check_positive_definite(self.covariance)

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.covariance.shape[-1]

    def at_level(self, level: float) -> Self:
        """Return the covariances at one noise level, which is in multiples of the largest level in training."""
        return type(self)(np.zeros(1), self.ages, interpolated(level, self.levels, self.covariance)[None])

    def __call__(self, age: np.ndarray | float, shape: tuple[int, ...] = ()) -> np.ndarray:
        """Return covariances (..., nx, nx) at ages for the level given to at_level, broadcast to ``shape`` if given."""
        return interpolated(np.broadcast_to(age, shape or np.shape(age)), self.ages, self.covariance[0])


def interpolated(at: np.ndarray | float, points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate linearly at ``at`` between values (k, ...) at rising points (k,); constant beyond the ends."""
    last = len(points) - 1
    i = np.clip(np.searchsorted(points, at, side="right"), min(1, last), last)
    before = np.maximum(i - 1, 0)
    share = np.clip((at - points[before]) / np.where(i > before, points[i] - points[before], 1.0), 0.0, 1.0)
    share = share.reshape(np.shape(at) + (1,) * (values.ndim - 1))
    return np.asarray((1 - share) * values[before] + share * values[i])


def check_positive_definite(covariance: np.ndarray) -> None:
    """Raise ArtifactError unless covariances (..., n, n) are positive definite; units of the states do not matter."""
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    if (variances > 0).all():
        scale = np.sqrt(variances)
        correlation = covariance / (scale[..., :, None] * scale[..., None, :])
        if np.allclose(correlation, correlation.mT) and (np.linalg.eigvalsh(correlation) > 0).all():
            return
    raise ArtifactError(f"a covariance must be positive definite, got {shown(covariance)}")


def standard_deviations(covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations (..., nx) of covariances (..., nx, nx)."""
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
