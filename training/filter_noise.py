"""What measurement noise becomes in the filter, in closed form."""

from collections.abc import Iterator

import numpy as np
import scipy

from observers import LinearFilter


def noise_covariance(linear: LinearFilter, ages: np.ndarray) -> np.ndarray:
    """Covariances (ages, ny, size, size) of z's error due to unit white noise on each output, by age in samples."""
    phi = linear.transition
    out = np.empty((len(ages), linear.B.shape[1], linear.size, linear.size))
    for j, (early, late, equilibrium) in enumerate(_columns(linear)):
        drive = phi @ late + early
        after_first = phi @ equilibrium + early  # s_1 = after_first v_0
        own = late @ late.T
        covariance, at = after_first @ after_first.T, 1
        for i, age in enumerate(ages):
            if age == 0:
                out[i, j] = equilibrium @ equilibrium.T
                continue
            for _ in range(int(age) - at):
                covariance = phi @ covariance @ phi.T + drive @ drive.T
            at = int(age)
            out[i, j] = covariance + own
    return out


def stationary_covariance(linear: LinearFilter) -> np.ndarray:
    """Limit of :func:`noise_covariance` at great ages, (ny, size, size)."""
    phi = linear.transition
    out = []
    for early, late, _ in _columns(linear):
        drive = phi @ late + early
        out.append(scipy.linalg.solve_discrete_lyapunov(phi, drive @ drive.T) + late @ late.T)
    return np.array(out)


def _columns(linear: LinearFilter) -> Iterator[tuple[np.ndarray, ...]]:
    """What each output acts through: its columns of early_y, late_y and equilibrium, each (size, 1)."""
    for j in range(linear.B.shape[1]):
        yield tuple(matrix[:, j : j + 1] for matrix in (linear.early_y, linear.late_y, linear.equilibrium))


def root(covariance: np.ndarray) -> np.ndarray:
    """Matrices R with R R^T = covariance, (..., size, size), also where rounding made small eigenvalues negative."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])
