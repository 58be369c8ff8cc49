"""Gaussians through functions that are not linear, by sigma points, for a batch of them.

The points are the mean +- sqrt(nx + kappa) times each column of the covariance's Cholesky factor, and the mean itself
(Wan and van der Merwe, 2000, with alpha = 1). They are drawn anew for outputs that are not linear.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Gaussian = tuple[np.ndarray, np.ndarray]
"""Means (n, nx) and covariances (n, nx, nx)."""


@dataclass(frozen=True)
class Points:
    """Which sigma points are drawn."""

    kappa: float
    beta: float

    def weights(self, nx: int) -> tuple[float, float, float]:
        """What the mean weighs in means and in covariances, and each other point in both."""
        middle = self.kappa / (nx + self.kappa)
        return middle, middle + self.beta, 1 / (2 * (nx + self.kappa))

    def of(self, x: np.ndarray, P: np.ndarray) -> np.ndarray:
        """Those of means (n, nx) and covariances (n, nx, nx): (points, n, nx); NaN where these are none."""
        columns = math.sqrt(x.shape[-1] + self.kappa) * factor(P).transpose(2, 0, 1)
        return np.concatenate([x[None], x + columns, x - columns])

    def moments(self, moved: np.ndarray, nx: int) -> Gaussian:
        """Mean (n, k) of points (points, n, k), and what these differ from it by."""
        middle, _, other = self.weights(nx)
        mean = other * moved[1:].sum(0) + middle * moved[0]
        return mean, moved - mean

    def products(self, a: np.ndarray, b: np.ndarray, nx: int) -> np.ndarray:
        """Sum over points of outer products of (points, n, k) and (points, n, l), as (n, k, l)."""
        _, middle, other = self.weights(nx)
        weighted = other * a
        weighted[0] *= middle / other
        products: np.ndarray = weighted.transpose(1, 2, 0) @ b.transpose(1, 0, 2)
        return products


def transformed(
    x: np.ndarray, P: np.ndarray, *, function: Callable[[np.ndarray], np.ndarray], points: Points
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a function makes of a batch of Gaussians: means (n, k), covariances (n, k, k) and across (n, nx, k)."""
    nx, at = x.shape[-1], points.of(x, P)
    mean, spread = points.moments(function(at), nx)
    return mean, points.products(spread, spread, nx), points.products(at - x, spread, nx)


def whitened(
    innovation: np.ndarray, S: np.ndarray, across: np.ndarray, missing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """V (n, nx, ny) and white innovations (n, ny), by which samples make x + V white and P - V V^T of x and P.

    Shapes: ``innovation``, ``missing`` (n, ny), ``S`` (n, ny, ny), ``across`` (n, nx, ny).
    """
    if missing.any():
        innovation = np.where(missing, 0.0, innovation)
        across = np.where(missing[:, None, :], 0.0, across)
        S = np.where(missing[:, None, :] | missing[..., None], np.eye(S.shape[-1]), S)  # apart from those measured
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
    """Solve P X = b, (n, nx, k), for covariances P; NaN where one is not positive definite."""
    root = factor(P)
    solution: np.ndarray = np.linalg.solve(root.mT, np.linalg.solve(root, b))
    return solution


def factor(P: np.ndarray) -> np.ndarray:
    """Cholesky factors (n, nx, nx) of covariances; NaN where one is not positive definite or not finite."""
    try:
        found: np.ndarray = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:  # which says that there is one, not which
        found = np.full_like(P, np.nan)
        rows = np.flatnonzero(np.isfinite(P).all((1, 2)))
        if len(P) > 1:
            for half in np.array_split(rows, 2):
                found[half] = factor(P[half])
    return found
