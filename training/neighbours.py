"""What one thing tells of another, from samples of both: neighbours in the one, and how far they differ in the other.

Of each sample that asks, the nearest others are weighed so that their z, weighted, is its own: a plane through them.
Their x, weighted, is then off by what z does not tell, of the sample itself and of the others, and by how far x bends
between them, which falls with the square of their distance. The first part is divided by 1 + sum of squared weights,
as which it counts the variance; it is what is left where neighbours come as close as one likes. With one neighbour of
weight 1 that is the Delta test.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

RESOLUTION = 1e-3  # to which a network reads z, in standard deviations: what is left where there is no noise
FEWEST = 32  # neighbours, or twice as many as z has coordinates, so that planes rest on enough of them
ROUNDING = 1e-9  # of z, in a linear regression


@dataclass(frozen=True)
class Told:
    """What z tells of x. Shapes: ``left`` (nx,), ``linear`` (nx,)."""

    left: np.ndarray
    linear: np.ndarray


def told(z: np.ndarray, x: np.ndarray, *, others_z: np.ndarray, others_x: np.ndarray) -> Told:
    """Find what z tells of x. Shapes: ``z`` (n, modes), ``x`` (n, nx), ``others_z``, ``others_x`` (m, ...)."""
    deviation = np.where(np.ptp(x, 0) > 0, x.std(0), np.nan)
    design = np.column_stack([np.ones(len(others_z)), others_z])
    gram = design.T @ design + ROUNDING * len(design) * np.eye(len(design.T))
    coefficients = np.linalg.solve(gram, design.T @ others_x)
    others_x = others_x - design @ coefficients  # what is bent alone need be found from neighbours
    x = x - np.column_stack([np.ones(len(z)), z]) @ coefficients
    linear = np.sqrt((x**2).mean(0)) / deviation
    if not z.shape[1]:
        return Told(linear, linear)
    count = min(len(others_z), max(FEWEST, 2 * (z.shape[1] + 1)))
    near = cKDTree(others_z).query(z, k=count)[1]
    weights = _weights(others_z[near] - z[:, None])
    squared = (np.einsum("nk,nkj->nj", weights, others_x[near]) - x) ** 2 / (1 + (weights**2).sum(1))[:, None]
    return Told(np.minimum(np.sqrt(squared.mean(0)) / deviation, linear), linear)


def _weights(apart: np.ndarray) -> np.ndarray:
    """Weights (n, k) with the sum 1 of neighbours that are ``apart`` (n, k, modes), for which these cancel.

    They are the smallest for which that is so to RESOLUTION.
    """
    n, k, modes = apart.shape
    gram = apart @ apart.mT + RESOLUTION**2 * modes * np.eye(k)
    weights = np.linalg.solve(gram, np.ones((n, k, 1)))[..., 0]
    return np.asarray(weights / weights.sum(1, keepdims=True))
