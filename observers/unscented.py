"""Gaussians through functions that are not linear, by sigma points, for a batch of them.

The points are the mean +- sqrt(nx + kappa) times each column of the covariance's Cholesky factor, and the mean itself
where it has a weight (Wan and van der Merwe, 2000, with alpha = 1). They are drawn anew for outputs that are not
linear.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Gaussian = tuple[np.ndarray, np.ndarray]
"""Means (n, nx) and covariances (n, nx, nx)."""


@dataclass(frozen=True)
class Points:
    """How sigma points are chosen; by default as in the cubature Kalman filter (Arasaratnam and Haykin, 2009).

    That has no point in the middle, and all weigh the same.

    Parameters
    ----------
    kappa : float
        How much farther out than sqrt(nx) they are, as above. It is also what the mean weighs, in points.
    beta : float
        What the mean weighs more in covariances, in multiples of all points together.
    """

    kappa: float = 0.0
    beta: float = 0.0

    def weights(self, nx: int) -> tuple[float, float, float]:
        """What the mean weighs in means and in covariances, and each other point in both."""
        middle = self.kappa / (nx + self.kappa)
        return middle, middle + self.beta, 1 / (2 * (nx + self.kappa))

    def of(self, x: np.ndarray, P: np.ndarray) -> np.ndarray:
        """Those of means (n, nx) and covariances (n, nx, nx): (points, n, nx); NaN where these are none."""
        columns = math.sqrt(x.shape[-1] + self.kappa) * factor(P).transpose(2, 0, 1)
        return np.concatenate([*([x[None]] if self._middle else []), x + columns, x - columns])

    def moments(self, moved: np.ndarray, nx: int) -> Gaussian:
        """Mean (n, k) of points (points, n, k), and what these differ from it by."""
        middle, _, other = self.weights(nx)
        mean = other * moved[1:].sum(0) + middle * moved[0] if self._middle else other * moved.sum(0)
        return mean, moved - mean

    def products(self, a: np.ndarray, b: np.ndarray, nx: int) -> np.ndarray:
        """Sum over points of outer products of (points, n, k) and (points, n, l), as (n, k, l)."""
        _, middle, other = self.weights(nx)
        weighted = other * a
        if self._middle:
            weighted[0] *= middle / other
        products: np.ndarray = weighted.transpose(1, 2, 0) @ b.transpose(1, 0, 2)
        return products

    @property
    def _middle(self) -> bool:
        """Whether the mean is one of them."""
        return bool(self.kappa or self.beta)


CUBATURE = Points()


def predicted(
    x: np.ndarray, P: np.ndarray, *, move: Callable[[np.ndarray], np.ndarray], Q: np.ndarray, points: Points = CUBATURE
) -> Gaussian:
    """Move a batch of Gaussians.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    move : callable
        Takes sigma points (points, n, nx) to where they are later.
    Q : ndarray, shape (nx, nx)
        Covariance of what is added on the way.
    points : Points
        How they are chosen.

    Returns
    -------
    tuple of ndarray
        Means and covariances later; NaN where a covariance was none.
    """
    nx = x.shape[-1]
    mean, spread = points.moments(move(points.of(x, P)), nx)
    return mean, points.products(spread, spread, nx) + Q


def corrected(
    x: np.ndarray,
    P: np.ndarray,
    y: np.ndarray,
    *,
    output: Callable[[np.ndarray], np.ndarray],
    R: np.ndarray,
    points: Points = CUBATURE,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Condition a batch of Gaussians on samples.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    y : ndarray, shape (n, ny)
        Samples; NaN where they are missing, which corrects nothing.
    output : callable
        h: sigma points (points, n, nx) to outputs (points, n, ny).
    R : ndarray, shape (ny, ny)
        Covariance of the noise on the samples.
    points : Points
        How they are chosen.

    Returns
    -------
    x, P : ndarray
        Means and covariances given the samples; NaN where a covariance was none, or h is undefined at a sigma point.
    nis : ndarray, shape (n,)
        Normalised innovations squared, per output that was measured: 1 on average where all is as assumed.
    """
    expected, S, across = transformed(x, P, function=output, points=points)
    x, P, white = conditioned(x, P, y - expected, S + R, across, np.isnan(y))
    return x, P, (white**2).sum(-1) / np.maximum((~np.isnan(y)).sum(-1), 1)


def transformed(
    x: np.ndarray, P: np.ndarray, *, function: Callable[[np.ndarray], np.ndarray], points: Points = CUBATURE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a function makes of a batch of Gaussians.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    function : callable
        Takes sigma points (points, n, nx) to (points, n, k).
    points : Points
        How they are chosen.

    Returns
    -------
    tuple of ndarray, shapes (n, k), (n, k, k) and (n, nx, k)
        Means, covariances, and covariances of the states with them; NaN where a covariance was none.
    """
    nx, at = x.shape[-1], points.of(x, P)
    mean, spread = points.moments(function(at), nx)
    return mean, points.products(spread, spread, nx), points.products(at - x, spread, nx)


def conditioned(
    x: np.ndarray,
    P: np.ndarray,
    innovation: np.ndarray,
    S: np.ndarray,
    across: np.ndarray,
    missing: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Condition a batch of Gaussians on what samples differ by from what was expected.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    innovation : ndarray, shape (n, ny)
        Samples less what was expected.
    S, across : ndarray, shapes (n, ny, ny) and (n, nx, ny)
        Covariances of the innovations, and of the states with them.
    missing : ndarray of bool, shape (n, ny), optional
        The samples that are missing, which correct nothing; by default where the innovation is NaN.

    Returns
    -------
    x, P : ndarray
        As :func:`corrected` has them.
    white : ndarray, shape (n, ny)
        Innovations less what those of the outputs before say of them, in units of their standard deviation: where all
        is as assumed, they are independent and of variance 1. 0 where samples are missing.
    """
    missing = np.isnan(innovation) if missing is None else missing
    if missing.any():
        innovation = np.where(missing, 0.0, innovation)
        across = np.where(missing[:, None, :], 0.0, across)
        S = np.where(missing[:, None, :] | missing[..., None], np.eye(S.shape[-1]), S)  # apart from those measured
    told = np.concatenate([across.mT, innovation[..., None]], axis=-1)
    white = told / np.sqrt(S) if S.shape[-1] == 1 else np.linalg.solve(factor(S), told)
    change = white[..., :-1].mT @ white  # K S K^T, and K times the innovation
    return x + change[..., -1], P - change[..., :-1], white[..., -1]


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


__all__ = ["CUBATURE", "Points", "conditioned", "corrected", "factor", "predicted", "transformed"]
