"""How many errors lie in the regions that covariances state, and how large the errors are against these."""

from dataclasses import dataclass

import numpy as np

from kkl_gym.system import System
from observers import Artifact
from observers.factors import standard_deviations
from training.calibration import chi_square, squared_distance
from training.evaluation.errors import UnseenTrajectories, estimates
from training.evaluation.levels import Level

REGIONS = (0.5, 0.9, 0.99)  # shares of the errors
INTERVAL = 0.95  # of the mean NEES of a consistent filter


@dataclass(frozen=True)
class Coverage:
    """Shares of errors in the regions (regions,) of covariances, jointly and by state, in a span of time."""

    joint: np.ndarray
    states: np.ndarray
    nees: float
    limits: tuple[float, float]


def coverage(
    artifact: Artifact | None,
    system: System,
    trajectories: UnseenTrajectories,
    *,
    measurement_noise: Level,
    seed: int,
    spans: tuple[slice, ...] = (slice(None),),
) -> list[Coverage]:
    """Compare covariances with errors on test trajectories; arguments are those of :func:`training.errors`."""
    if artifact is not None:
        artifact.require_covariance()
    x_hat, P = estimates(
        artifact, system, trajectories, measurement_noise=measurement_noise, seed=seed, covariances=True
    )
    assert P is not None
    error = trajectories.x - x_hat
    nees, ratios = squared_distance(error, P), (error / standard_deviations(P)) ** 2
    _, n, nx = error.shape
    joint, single = chi_square(REGIONS, nx), chi_square(REGIONS, 1)
    low, high = (float(chi_square((1 + side * INTERVAL) / 2, n * nx) / n) for side in (-1, 1))
    return [
        Coverage(
            np.array([(nees[span] <= edge).mean() for edge in joint]),
            np.array([(ratios[span] <= edge).mean((0, 1)) for edge in single]),
            float(nees[span].mean()),
            (low, high),
        )
        for span in spans
    ]
