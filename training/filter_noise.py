"""What measurement noise becomes in the filter, in closed form."""

import numpy as np
import scipy

from observers import LinearFilter


def noise_covariance(linear: LinearFilter, ages: np.ndarray) -> np.ndarray:
    """Covariance of the filter's error due to unit white noise on the output, by the number of samples since reset.

    Parameters
    ----------
    linear : LinearFilter
        The filter.
    ages : ndarray of int, shape (n,)
        Samples since reset, sorted.

    Returns
    -------
    ndarray, shape (n, size, size)
        For a standard deviation of 1; the covariance is proportional to its square.

    Notes
    -----
    With e_k the part of z_k that the noise v_0, ..., v_k causes, e_0 = E v_0 and
    e_k+1 = Phi e_k + early v_k + late v_k+1: neighbouring increments share a sample of noise. What is uncorrelated
    with v_k is s_k = e_k - late v_k, for which s_k+1 = Phi s_k + (Phi late + early) v_k; that recursion is summed
    exactly. Many samples after reset the covariance is the solution of its discrete Lyapunov equation.
    """
    phi, late = linear.transition, linear.late_y
    drive = phi @ late + linear.early_y
    after_first = phi @ linear.equilibrium + linear.early_y  # s_1 = after_first v_0
    own = late @ late.T
    out = np.empty((len(ages), linear.size, linear.size))
    covariance, at = after_first @ after_first.T, 1
    for i, age in enumerate(ages):
        if age == 0:
            out[i] = linear.equilibrium @ linear.equilibrium.T
            continue
        for _ in range(int(age) - at):
            covariance = phi @ covariance @ phi.T + drive @ drive.T
        at = int(age)
        out[i] = covariance + own
    return out


def stationary_covariance(linear: LinearFilter) -> np.ndarray:
    """Limit of :func:`noise_covariance` at great ages, (size, size)."""
    phi, late = linear.transition, linear.late_y
    drive = phi @ late + linear.early_y
    return np.asarray(scipy.linalg.solve_discrete_lyapunov(phi, drive @ drive.T) + late @ late.T)


def root(covariance: np.ndarray) -> np.ndarray:
    """Matrices R with R R^T = covariance, (..., size, size), also where rounding made small eigenvalues negative."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])
