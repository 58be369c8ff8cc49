"""What the filter makes of measurement noise: the theorem's gain, and the exact ones."""

import numpy as np
from scipy.optimize import minimize_scalar

from observers import LinearFilter
from training.filter_noise import stationary_covariance


def theorem_gain(linear: LinearFilter) -> float:
    """cond(V) |B| / |lambda_min(A)|, by which a bounded noise may move z in the paper's theorem 4 (sec. 7)."""
    poles, V = np.linalg.eig(linear.A)
    return float(np.linalg.cond(V) * np.linalg.norm(linear.B, 2) / np.abs(poles.real).min())


def h_infinity(linear: LinearFilter, points: int = 2000) -> float:
    """H-infinity norm of the sampled filter from v to z: the largest amplification of a noise's energy.

    The greatest gain on a grid of frequencies up to Nyquist's, finer about the poles', and refined about the best one.
    """
    poles = np.linalg.eigvals(linear.A) * linear.dt
    near = np.geomspace(1e-2, 1e2, 40)
    resonances = np.abs(poles.imag) + np.outer([*-near, 0.0, *near], np.abs(poles.real))
    grid = np.concatenate([[0.0], np.geomspace(min(1e-3, 0.01 * np.abs(poles).min()), np.pi, points)])
    grid = np.unique(np.concatenate([grid, np.clip(resonances.ravel(), 0.0, np.pi)]))
    gains = np.array([_gain(linear, w) for w in grid])
    best = int(gains.argmax())
    low, high = grid[max(0, best - 1)], grid[min(len(grid) - 1, best + 1)]
    refined = minimize_scalar(
        lambda w: -_gain(linear, w), bounds=(low, high), method="bounded", options={"xatol": 1e-10}
    )
    return float(max(gains[best], -refined.fun))


def h2(linear: LinearFilter) -> float:
    """H2 norm from v to z: the stationary rms of |z| under white noise of unit variance on every sample."""
    return float(np.sqrt(np.trace(stationary_covariance(linear))))


def _gain(linear: LinearFilter, frequency: float) -> float:
    """Largest singular value of the transfer function from v to z at a frequency in radians per sample."""
    s = np.exp(1j * frequency)
    size = len(linear.transition)
    response = np.linalg.solve(s * np.eye(size) - linear.transition, linear.early_y + s * linear.late_y)
    return float(np.linalg.norm(response, 2))
