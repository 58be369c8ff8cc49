"""Gaussians through functions that are not linear, by sigma points, for a batch of them.

The points are van der Merwe's scaled ones with alpha = 1, beta = 2 and kappa = 3 - nx: the mean, and the mean +-
sqrt(3) times each column of the covariance's Cholesky factor (Wan and van der Merwe, 2000). They are drawn anew for
outputs that are not linear.
"""

import math
from collections.abc import Callable

import numpy as np

LEAST_EIGENVALUE = 1e-13  # of a covariance, over its largest: below that its factor would be rounding

Gaussian = tuple[np.ndarray, np.ndarray]
"""Means (n, nx) and covariances (n, nx, nx)."""


def predicted(x: np.ndarray, P: np.ndarray, *, move: Callable[[np.ndarray], np.ndarray], Q: np.ndarray) -> Gaussian:
    """Move a batch of Gaussians.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    move : callable
        Takes points (2 nx + 1, n, nx) to where they are later.
    Q : ndarray, shape (nx, nx)
        Covariance of what is added on the way.

    Returns
    -------
    tuple of ndarray
        Means and covariances later; NaN where a covariance was none.
    """
    mean, spread = _moments(move(sigma_points(x, P)))
    return mean, _products(spread, spread) + Q


def corrected(
    x: np.ndarray, P: np.ndarray, y: np.ndarray, *, output: Callable[[np.ndarray], np.ndarray], R: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Condition a batch of Gaussians on samples.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    y : ndarray, shape (n, ny)
        Samples; NaN where they are missing, which corrects nothing.
    output : callable
        h: points (2 nx + 1, n, nx) to outputs (2 nx + 1, n, ny).
    R : ndarray, shape (ny, ny)
        Covariance of the noise on the samples.

    Returns
    -------
    x, P : ndarray
        Means and covariances given the samples; NaN where a covariance was none.
    nis : ndarray, shape (n,)
        Normalised innovations squared, per output that was measured: 1 on average where all is as assumed.
    """
    expected, S, across = transformed(x, P, function=output)
    return conditioned(x, P, y - expected, S + R, across)


def transformed(
    x: np.ndarray, P: np.ndarray, *, function: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a function makes of a batch of Gaussians.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    function : callable
        Takes points (2 nx + 1, n, nx) to (2 nx + 1, n, k).

    Returns
    -------
    tuple of ndarray, shapes (n, k), (n, k, k) and (n, nx, k)
        Means, covariances, and covariances of the states with them; NaN where a covariance was none.
    """
    points = sigma_points(x, P)
    mean, spread = _moments(function(points))
    return mean, _products(spread, spread), _products(points - x, spread)


def conditioned(
    x: np.ndarray, P: np.ndarray, innovation: np.ndarray, S: np.ndarray, across: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Condition a batch of Gaussians on what samples differ by from what was expected.

    Parameters
    ----------
    x, P : ndarray, shapes (n, nx) and (n, nx, nx)
        Means and covariances.
    innovation : ndarray, shape (n, ny)
        Samples less what was expected; NaN where they are missing, which corrects nothing.
    S, across : ndarray, shapes (n, ny, ny) and (n, nx, ny)
        Covariances of the innovations, and of the states with them.

    Returns
    -------
    x, P, nis
        As :func:`corrected` has them.
    """
    missing, measured = np.isnan(innovation), innovation.shape[1]
    if missing.any():
        innovation = np.where(missing, 0.0, innovation)
        across = np.where(missing[:, None, :], 0.0, across)
        S = np.where(missing[:, None, :] | missing[..., None], np.eye(measured), S)  # apart from those measured
        measured = np.maximum(measured - missing.sum(-1), 1)
    told = np.concatenate([across.mT, innovation[..., None]], axis=-1)
    solved = told / S if S.shape[-1] == 1 else np.linalg.solve(S, told)
    nis = (innovation * solved[..., -1]).sum(-1) / measured
    change = solved[..., :-1].mT @ told  # K S K^T, and K times the innovation
    return x + change[..., -1], P - change[..., :-1], nis


def sigma_points(x: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Sigma points (2 nx + 1, n, nx) of means (n, nx) and covariances (n, nx, nx); NaN where these are none."""
    columns = math.sqrt(3.0) * factor(P).transpose(2, 0, 1)
    return np.concatenate([x[None], x + columns, x - columns])


def factor(P: np.ndarray) -> np.ndarray:
    """Cholesky factors (n, nx, nx) of covariances; NaN where one is not positive definite or not finite."""
    try:
        found: np.ndarray = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:  # which says that there is one, not which
        found = np.full_like(P, np.nan)
        sound = np.isfinite(P).all((1, 2))
        eigenvalues = np.linalg.eigvalsh(P[sound])
        sound[sound] = eigenvalues[:, 0] > LEAST_EIGENVALUE * eigenvalues[:, -1]
        found[sound] = np.linalg.cholesky(P[sound])
    return found


def _moments(points: np.ndarray) -> Gaussian:
    """Weighted mean (n, k) of transformed points (2 nx + 1, n, k), and what the points differ from it by."""
    nx = len(points) // 2
    mean = (3 - nx) / 3 * points[0] + points[1:].sum(0) / 6
    return mean, points - mean


def _products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Weighted sum over points of outer products of (2 nx + 1, n, k) and (2 nx + 1, n, l), as (n, k, l)."""
    nx = len(a) // 2
    weighted = a / 6
    weighted[0] *= 6 * ((3 - nx) / 3 + 2.0)
    products: np.ndarray = weighted.transpose(1, 2, 0) @ b.transpose(1, 0, 2)
    return products


__all__ = ["conditioned", "corrected", "factor", "predicted", "sigma_points", "transformed"]
