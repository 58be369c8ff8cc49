"""What the filter makes of measurement noise, the theorem's gain and the exact ones, and what T_inv makes of that."""

import numpy as np
from scipy.optimize import minimize_scalar

from examples.research.certificates.smooth import decoder
from observers import Artifact, LinearFilter
from training.maps.coordinates import stationary_covariance


def theorem_gain(linear: LinearFilter) -> float:
    """Most that a bounded noise may move z by the paper's theorem 4 (sec. 7): cond(V) |B| / |lambda_min(A)|."""
    return _conditioning(linear) * float(np.linalg.norm(linear.B, 2)) / linear.slowest


def envelope(linear: LinearFilter, ages: np.ndarray, *, start: float, disturbance: float = 0.0) -> np.ndarray:
    """Bound |z(t) - T(x(t))| from the reset on (paper, lemma zeta_bound, with the sign of its exponent put right).

    Shapes: ``ages`` (m,); returns (m,).
    """
    left = np.exp(-linear.slowest * ages)
    return np.asarray(_conditioning(linear) * left * start + theorem_gain(linear) * (1.0 - left) * disturbance)


def controllability(linear: LinearFilter) -> float:
    """Smallest singular value of [A - s I, B] over the eigenvalues s of A; (A, B) is controllable if it is not zero.

    This is the test of Popov, Belevitch and Hautus. The rank of [B, A B, ...], which the paper asks for, is the same
    in exact arithmetic, but floats cannot tell it.
    """
    identity = np.eye(len(linear.A))
    pencils = [np.hstack([linear.A - s * identity, linear.B]) for s in np.linalg.eigvals(linear.A)]
    return float(min(np.linalg.svd(pencil, compute_uv=False)[-1] for pencil in pencils))


def _conditioning(linear: LinearFilter) -> float:
    return float(np.linalg.cond(np.linalg.eig(linear.A)[1]))


def h_infinity(linear: LinearFilter) -> float:
    """H-infinity norm of the sampled filter from v to z: the largest amplification of a noise's energy.

    The greatest gain is looked for among frequencies up to Nyquist's and some more about each pole, and then refined
    about the best one.
    """
    poles = np.linalg.eigvals(linear.A) * linear.dt
    near = np.geomspace(1e-2, 1e2, 40)
    resonances = np.abs(poles.imag) + np.outer([*-near, 0.0, *near], np.abs(poles.real))
    grid = np.concatenate([[0.0], np.geomspace(min(1e-3, 0.01 * np.abs(poles).min()), np.pi, 2000)])
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
    return float(np.sqrt(np.trace(stationary_covariance(linear).sum(0))))


def noise_variance(
    artifact: Artifact, z: np.ndarray, *, measurement_noise: float | tuple[float, ...], process_noise: float = 0.0
) -> np.ndarray:
    """Variance of the estimate due to stationary measurement noise, to first order: trace(J P J^T).

    P is the exact stationary covariance of z and J the Jacobian of T_inv.

    Shapes: ``z`` (n, size), ``measurement_noise`` of length ny; returns (n,).
    """
    J = decoder(artifact, measurement_noise, process_noise).jacobian(z)
    P = (np.reshape(measurement_noise, (-1, 1, 1)) ** 2 * stationary_covariance(artifact.filter)).sum(0)
    return np.asarray(np.einsum("nij,jk,nik->n", J, P, J))


def _gain(linear: LinearFilter, frequency: float) -> float:
    """Largest singular value of the transfer function from v to z at a frequency in radians per sample."""
    s = np.exp(1j * frequency)
    size = len(linear.transition)
    response = np.linalg.solve(s * np.eye(size) - linear.transition, linear.early_y + s * linear.late_y)
    return float(np.linalg.norm(response, 2))
