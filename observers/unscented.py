"""Unscented transforms: batches of Gaussians through nonlinear functions, by sigma points.

The points are the mean, and the mean +- sqrt(nx + kappa) times each column of the covariance's Cholesky factor (Wan and
van der Merwe, 2000, with alpha = 1, beta = 2). A nonlinear output uses new points, from the predicted covariance.
"""

import math
from collections.abc import Callable

import numpy as np

_BETA = 2.0


def weights(nx: int) -> tuple[float, float, float]:
    """Return the central point's weight in means, its weight in covariances, and each outer point's weight in both."""
    middle = (_scale(nx) - nx) / _scale(nx)
    return middle, middle + _BETA, 1 / (2 * _scale(nx))


def transformed(
    x: np.ndarray, P: np.ndarray, function: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a function's means (n, k), covariances (n, k, k) and covariances with x (n, nx, k), for Gaussian states x.

    Shapes: means ``x`` (n, nx), covariances ``P`` (n, nx, nx). The results are NaN if P is not positive definite.
    """
    nx = x.shape[-1]
    middle, middle_squares, other = weights(nx)
    columns = math.sqrt(_scale(nx)) * factor(P).transpose(2, 0, 1)
    at = np.concatenate([x[None], x + columns, x - columns])  # (points, n, nx)
    moved = function(at)
    mean = other * moved[1:].sum(0) + middle * moved[0]
    spread = moved - mean

    def products(a: np.ndarray) -> np.ndarray:
        weighted = other * a
        weighted[0] *= middle_squares / other
        return np.asarray(weighted.transpose(1, 2, 0) @ spread.transpose(1, 0, 2))

    return mean, products(spread), products(at - x)


def _scale(nx: int) -> float:
    """Return nx + kappa, with kappa = max(3 - nx, 0)."""
    return max(float(nx), 3.0)


def whitened(
    innovation: np.ndarray, S: np.ndarray, across: np.ndarray, missing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return V (n, nx, ny) and whitened innovations ``white`` (n, ny): x and P become x + V white and P - V V^T.

    ``S`` (n, ny, ny) is the innovations' covariance, and ``across`` (n, nx, ny) the covariance of states and outputs.
    """
    if missing.any():
        innovation = np.where(missing, 0.0, innovation)
        across = np.where(missing[:, None, :], 0.0, across)
        S = np.where(missing[:, None, :] | missing[..., None], np.eye(S.shape[-1]), S)  # decouples missing outputs
    if S.shape[-1] == 1:
        root = np.sqrt(S[:, 0])
        return across / root[..., None], innovation / root
    both = np.linalg.solve(factor(S), np.concatenate([across.mT, innovation[..., None]], axis=-1))
    return both[..., :-1].mT, both[..., -1]


def shift(x: np.ndarray, V: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return x + V white."""
    return x + (V @ white[..., None])[..., 0]


def add(P: np.ndarray, V: np.ndarray, W: np.ndarray, sign: float = 1.0) -> np.ndarray:
    """Return P + sign V W^T."""
    return P + sign * (V @ W.mT)


def solved(P: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the solution X (n, nx, k) of P X = b for covariances P; NaN if P is not positive definite."""
    root = factor(P)
    solution: np.ndarray = np.linalg.solve(root.mT, np.linalg.solve(root, b))
    return solution


def factor(P: np.ndarray) -> np.ndarray:
    """Return the Cholesky factors (n, nx, nx) of covariances, NaN where P is not positive definite or not finite."""
    try:
        root: np.ndarray = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:  # the error does not name the failing matrices; halving the batch finds them
        root = np.full_like(P, np.nan)
        rows = np.flatnonzero(np.isfinite(P).all((1, 2)))
        if len(P) > 1:
            for half in np.array_split(rows, 2):
                root[half] = factor(P[half])
    return root
