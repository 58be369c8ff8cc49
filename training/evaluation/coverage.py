"""Consistency of covariances: the shares of errors in their confidence regions, and the mean NEES."""

from kkl_gym.system import System
from observers import Artifact
from observers.factors import standard_deviations
from training.calibration import chi_square, squared_distance
from training.evaluation.errors import UnseenTrajectories, estimates
from training.evaluation.levels import Level

REGIONS = {"50": 0.5, "90": 0.9, "99": 0.99}  # nominal shares of errors, by their names in tables
INTERVAL = 0.95  # probability that a consistent filter's NEES, averaged over trajectories at a sample, is in the limits


def coverage(
    artifact: Artifact | None,
    system: System,
    trajectories: UnseenTrajectories,
    *,
    measurement_noise: Level,
    seed: int,
    spans: tuple[slice, ...] = (slice(None),),
) -> list[dict[str, float]]:
    """Compare covariances with errors on test trajectories; for arguments except ``spans`` see :func:`training.errors`.

    Returns for each span of samples the percentages of errors in the regions, for all states together ("90") and for
    each state ("90 x1"), the mean NEES, and limits for a consistent filter's trajectory-averaged NEES at one sample.
    """
    x_hat, P = estimates(
        artifact, system, trajectories, measurement_noise=measurement_noise, seed=seed, covariances=True
    )
    error = trajectories.x - x_hat
    squares, (_, n, nx) = (error / standard_deviations(P)) ** 2, error.shape
    nees, table = squared_distance(error, P), []
    low, high = (float(chi_square((1 + side * INTERVAL) / 2, n * nx) / n) for side in (-1, 1))
    for span in spans:
        shares = dict[str, float]()
        for name, region in REGIONS.items():
            shares[name] = 100 * float((nees[span] <= chi_square(region, nx)).mean())
            for state, ratios in zip(system.state_names, squares[span].T, strict=True):
                shares[f"{name} {state}"] = 100 * float((ratios <= chi_square(region, 1)).mean())
        table.append(shares | {"nees": float(nees[span].mean()), "nees_low": low, "nees_high": high})
    return table
