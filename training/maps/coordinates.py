"""Inputs and outputs of the networks: whitened coordinates of z with their noise, and scaled states."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy

from observers import LinearFilter
from training.config import Scaling

SMALLEST_MODE = 1e-7  # least ratio of a singular value of z to the largest; directions below it are rounding errors
STILL = 1e-12  # least ratio of a component's standard deviation to its largest value; less is rounding error
SETTLED = np.log(1e3)  # number of time constants after which a thousandth of a filter's start is left
LEAST = 0.1  # the loss divides square errors by the mean square of x / scale plus this, lest states near 0 dominate


@dataclass(frozen=True)
class Coordinates:
    """Coordinates in which the covariance of given samples of z is the identity, and that of their noise diagonal.

    A network in float32 cannot read z itself: components of z are nearly collinear, and variances along its principal
    axes spread over ten orders of magnitude. ``noise_gain`` holds the noise's standard deviation in each coordinate.

    Shapes, for ``modes`` coordinates: ``offset`` (size,), ``whiten`` (modes, size), ``noise_gain`` (modes,).
    """

    offset: np.ndarray
    whiten: np.ndarray
    noise_gain: np.ndarray

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """Map filter states (..., size) to coordinates (..., modes)."""
        return np.asarray((z - self.offset) @ self.whiten.T)


def coordinates(z: np.ndarray, noise: np.ndarray, silent: np.ndarray | None = None) -> Coordinates:
    """Find coordinates for ``z`` (n, size) and noise with covariance ``noise``, without the directions ``silent``."""
    if silent is not None and silent.size:
        projection = np.eye(len(silent)) - silent @ np.linalg.pinv(silent)
        rest = coordinates(z @ projection.T, projection @ noise @ projection.T)
        return replace(rest, whiten=rest.whiten @ projection)
    offset, scale = z.mean(0), spread(z)
    _, singular, directions = np.linalg.svd((z - offset) / scale, full_matrices=False)
    keep = singular > SMALLEST_MODE * singular[0]
    whiten = directions[keep] / singular[keep, None] * np.sqrt(len(z)) / scale
    variances, rotation = np.linalg.eigh(whiten @ noise @ whiten.T)
    return Coordinates(offset, rotation.T @ whiten, np.sqrt(np.maximum(variances, 0.0)))


def spread(z: np.ndarray) -> np.ndarray:
    """Return the standard deviations (size,) of samples (n, size), or 1 where a component does not move."""
    deviation = z.std(0)
    return np.where(deviation > STILL * np.abs(z).max(0), deviation, 1.0)


def settling_time(linear: LinearFilter) -> float:
    """Return the time in seconds after which a thousandth of the filter's start is left."""
    return float(SETTLED / linear.slowest)


def noise_covariance(linear: LinearFilter, ages: np.ndarray) -> np.ndarray:
    """Return covariances (ages, ny, size, size) of z's error by age (samples), for unit white noise on each output."""
    phi, (early, late, equilibrium) = linear.transition, _columns(linear)
    # For noise v_k, z_k = s_k + late v_k with s_1 = after_first v_0 and s_(k+1) = phi s_k + drive v_k.
    drive, after_first = phi @ late + early, phi @ equilibrium + early
    covariance, at, out = after_first @ after_first.mT, 1, []
    for age in ages.astype(int):
        for _ in range(age - at):
            covariance = phi @ covariance @ phi.T + drive @ drive.mT
        at = max(at, age)
        out.append(covariance + late @ late.mT if age else equilibrium @ equilibrium.mT)
    return np.array(out)


def stationary_covariance(linear: LinearFilter) -> np.ndarray:
    """Return the limit (ny, size, size) of :func:`noise_covariance` at large ages."""
    phi, (early, late, _) = linear.transition, _columns(linear)
    drive = phi @ late + early
    return np.array([scipy.linalg.solve_discrete_lyapunov(phi, one) for one in drive @ drive.mT]) + late @ late.mT


def _columns(linear: LinearFilter) -> list[np.ndarray]:
    """Return the columns of early_y, late_y and equilibrium by output, as three arrays (ny, size, 1)."""
    return [matrix.T[..., None] for matrix in (linear.early_y, linear.late_y, linear.equilibrium)]


def root(covariance: np.ndarray) -> np.ndarray:
    """Return R (..., size, size) with R R^T = covariance; eigenvalues that rounding made negative count as 0."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


@dataclass(frozen=True)
class StateScale:
    """Scales states by an offset and a scale, (n,) each; :meth:`weight` reads the first ``nx`` states (None: all)."""

    offset: np.ndarray
    scale: np.ndarray
    relative: bool
    nx: int | None = None

    @classmethod
    def of(cls, x: np.ndarray, scaling: Scaling, *, nx: int | None = None) -> Self:
        """Determine offset and scale from states (..., n)."""
        axes = tuple(range(x.ndim - 1))
        if scaling == "relative":
            offset, scale = x.mean(axes), x.std(axes)
        else:
            low, high = x.min(axes), x.max(axes)
            offset, scale = (low + high) / 2, (high - low) / 2
        moves = scale > STILL * np.abs(x).max(axes)
        return cls(offset, np.where(moves, scale, 1.0), scaling == "relative", nx)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Scale states (..., n)."""
        return np.asarray((x - self.offset) / self.scale)

    def weight(self, x: np.ndarray) -> np.ndarray:
        """Return the weights (...,) of the square errors at states (..., n)."""
        if not self.relative:
            return np.ones(x.shape[:-1])
        return np.asarray(1.0 / (((x / self.scale)[..., : self.nx] ** 2).mean(-1) + LEAST))
