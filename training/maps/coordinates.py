"""What networks read and give: coordinates of z with the noise in them, and scaled states."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy

from observers import LinearFilter
from training.config import Scaling

# Modes of z that vary less than this part of the largest are left out, as they hold rounding errors.
SMALLEST_MODE = 1e-7
STILL = 1e-12  # part of a component's size below which its standard deviation is rounding
SETTLED = np.log(1e3)  # time constants after which a filter has forgotten its start to one part in a thousand
LEAST = 0.1  # added to the mean square of a scaled state, so that errors of small states do not dominate


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of z in which the signal has unit covariance and stationary noise a diagonal one.

    The components of z are nearly collinear, with variances that spread over ten orders of magnitude; a network
    in float32 cannot read them unless they are whitened.

    Shapes: ``offset`` (size,), ``whiten`` (modes, size), ``noise_gain`` (modes,).
    """

    offset: np.ndarray
    whiten: np.ndarray
    noise_gain: np.ndarray

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """Filter states (..., size) to coordinates (..., modes)."""
        return np.asarray((z - self.offset) @ self.whiten.T)


def coordinates(z: np.ndarray, noise: np.ndarray, silent: np.ndarray | None = None) -> Coordinates:
    """The coordinates for ``z`` (n, size) under ``noise`` (size, size), without the directions ``silent`` (size, k)."""
    if silent is not None and silent.size:
        telling = np.eye(len(silent)) - silent @ np.linalg.pinv(silent)
        rest = coordinates(z @ telling.T, telling @ noise @ telling.T)
        return replace(rest, whiten=rest.whiten @ telling)
    offset, scale = z.mean(0), spread(z)
    _, singular, directions = np.linalg.svd((z - offset) / scale, full_matrices=False)
    keep = singular > SMALLEST_MODE * singular[0]
    whiten = directions[keep] / singular[keep, None] * np.sqrt(len(z)) / scale
    variances, rotation = np.linalg.eigh(whiten @ noise @ whiten.T)
    return Coordinates(offset, rotation.T @ whiten, np.sqrt(np.maximum(variances, 0.0)))


def spread(z: np.ndarray) -> np.ndarray:
    """Standard deviations of a filter's states (n, size), in any units; 1 where one does not move."""
    deviation = z.std(0)
    return np.where(deviation > STILL * np.abs(z).max(0), deviation, 1.0)


def settling_time(linear: LinearFilter) -> float:
    """Time in seconds after which the filter has forgotten its start to one part in a thousand."""
    return float(SETTLED / linear.slowest)


def noise_covariance(linear: LinearFilter, ages: np.ndarray) -> np.ndarray:
    """Covariances (ages, ny, size, size) of z's error due to unit white noise on each output, by age in samples."""
    phi, (early, late, equilibrium) = linear.transition, _columns(linear)
    drive, after_first = phi @ late + early, phi @ equilibrium + early  # s_1 = after_first v_0
    covariance, at, out = after_first @ after_first.mT, 1, []
    for age in ages.astype(int):
        for _ in range(age - at):
            covariance = phi @ covariance @ phi.T + drive @ drive.mT
        at = max(at, age)
        out.append(covariance + late @ late.mT if age else equilibrium @ equilibrium.mT)
    return np.array(out)


def stationary_covariance(linear: LinearFilter) -> np.ndarray:
    """Limit of :func:`noise_covariance` at great ages, (ny, size, size)."""
    phi, (early, late, _) = linear.transition, _columns(linear)
    drive = phi @ late + early
    return np.array([scipy.linalg.solve_discrete_lyapunov(phi, one) for one in drive @ drive.mT]) + late @ late.mT


def _columns(linear: LinearFilter) -> list[np.ndarray]:
    """Each output's columns of early_y, late_y and equilibrium, each (ny, size, 1)."""
    return [matrix.T[..., None] for matrix in (linear.early_y, linear.late_y, linear.equilibrium)]


def root(covariance: np.ndarray) -> np.ndarray:
    """Matrices R with R R^T = covariance, (..., size, size), also where rounding made small eigenvalues negative."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


@dataclass(frozen=True)
class StateScale:
    """Scaled states are (x - offset) / scale. Shapes: ``offset`` (nx,), ``scale`` (nx,)."""

    offset: np.ndarray
    scale: np.ndarray
    relative: bool
    nx: int | None = None

    @classmethod
    def of(cls, x: np.ndarray, scaling: Scaling, *, nx: int | None = None) -> Self:
        """Find the scale of some states. Shapes: ``x`` (..., nx)."""
        axes = tuple(range(x.ndim - 1))
        if scaling == "relative":
            offset, scale = x.mean(axes), x.std(axes)
        else:
            low, high = x.min(axes), x.max(axes)
            offset, scale = (low + high) / 2, (high - low) / 2
        moves = scale > STILL * np.abs(x).max(axes)
        return cls(offset, np.where(moves, scale, 1.0), scaling == "relative", nx)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Scale states (..., nx)."""
        return np.asarray((x - self.offset) / self.scale)

    def weight(self, x: np.ndarray) -> np.ndarray:
        """Weights (...,) of the errors at states (..., nx)."""
        if not self.relative:
            return np.ones(x.shape[:-1])
        return np.asarray(1.0 / (((x / self.scale)[..., : self.nx] ** 2).mean(-1) + LEAST))
