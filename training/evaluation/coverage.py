"""Whether covariances are true: how many errors lie in the regions that should hold them, and how large they are."""

from dataclasses import dataclass

import numpy as np

from kkl_gym.system import System
from observers import Artifact
from observers.factors import standard_deviations
from training.calibration import chi_square, squared_distance
from training.evaluation.errors import UnseenTrajectories, follow, measured, observer_of
from training.evaluation.levels import Level

REGIONS = (0.5, 0.9, 0.99)  # parts of the errors that regions should hold
CHUNK = 200  # trajectories at once: each sample has a matrix
INTERVAL = 0.95  # of the mean NEES of a filter that is consistent


@dataclass(frozen=True)
class Coverage:
    """Shares of errors in the regions (regions,) of covariances, together and by state, in a span of time."""

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
    """Judge covariances on test trajectories; arguments are those of :func:`training.errors`."""
    if artifact is not None:
        artifact.require_covariance()
    observer = observer_of(artifact, system, trajectories, measurement_noise)
    y, x, distances, ratios = measured(system, trajectories, measurement_noise, seed), trajectories.x, [], []
    for first in range(0, x.shape[1], CHUNK):
        rows = slice(first, first + CHUNK)
        x_hat, covariance = follow(observer, y[:, rows], trajectories.u[:, rows], covariances=True)
        assert covariance is not None
        error = x[:, rows] - x_hat
        distances.append(squared_distance(error, covariance))
        ratios.append((error / standard_deviations(covariance)) ** 2)
    distance, ratio = (np.concatenate(each, 1) for each in (distances, ratios))
    nx, n = x.shape[-1], x.shape[1]
    joint, single = chi_square(REGIONS, nx), chi_square(REGIONS, 1)
    low, high = (float(chi_square((1 + side * INTERVAL) / 2, n * nx) / n) for side in (-1, 1))
    return [
        Coverage(
            np.array([(distance[span] <= edge).mean() for edge in joint]),
            np.array([(ratio[span] <= edge).mean((0, 1)) for edge in single]),
            float(distance[span].mean()),
            (low, high),
        )
        for span in spans
    ]
