"""Whether error bars are true: how many errors lie in the regions that should hold them, and how large they are."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.factors import standard_deviations
from training.evaluation.errors import UnseenTrajectories, kalman_filter, measured
from training.evaluation.levels import Level
from training.lessons.calibrate import chi_square, squared_distance

REGIONS = (0.5, 0.9, 0.99)  # parts of the errors that regions should hold
CHUNK = 200  # trajectories at once: each sample has a matrix
INTERVAL = 0.95  # of the mean NEES of a filter that is consistent


@dataclass(frozen=True)
class Coverage:
    """How many errors lie in the regions (regions,) that covariances say, together and by state, in a span of time."""

    joint: np.ndarray
    states: np.ndarray
    nees: float
    limits: tuple[float, float]


def coverage(
    artifact: Artifact,
    system: System,
    trajectories: UnseenTrajectories,
    *,
    measurement_noise: Level,
    seed: int,
    spans: tuple[slice, ...] = (slice(None),),
) -> list[Coverage]:
    """Judge an observer's error bars on test trajectories; it knows the levels of noise, nothing of another plant."""
    artifact.require_covariance()
    observer = KKLObserver(artifact, measurement_noise, process_noise=trajectories.process_noise)
    y = measured(system, trajectories, observer.measurement_noise, seed)

    def estimates() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for rows in _chunks(y.shape[1]):
            u = trajectories.u[:, rows] if artifact.nu else None
            yield _followed(observer, y[:, rows], u)

    return _judged(trajectories.x, estimates(), spans)


def kalman_coverage(
    system: System,
    trajectories: UnseenTrajectories,
    dt: float,
    *,
    measurement_noise: Level,
    seed: int,
    spans: tuple[slice, ...] = (slice(None),),
) -> list[Coverage]:
    """Judge the covariance that an extended Kalman filter says, on what :func:`coverage` takes."""
    y = measured(system, trajectories, measurement_noise, seed)

    def estimates() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        kalman = kalman_filter(system, dt, trajectories.process_noise, measurement_noise)
        for rows in _chunks(y.shape[1]):
            state, found = kalman.start(y[0, rows].shape[0]), []
            for k in range(len(y)):
                state = kalman.advance(state, y[k, rows], trajectories.u[k - 1, rows])  # the first input is ignored
                found.append((state.x, state.P))
            x_hat, P = zip(*found, strict=True)
            yield np.array(x_hat), np.array(P)

    return _judged(trajectories.x, estimates(), spans)


def _chunks(n: int) -> list[slice]:
    return [slice(first, first + CHUNK) for first in range(0, n, CHUNK)]


def _followed(observer: KKLObserver, y: np.ndarray, u: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and covariances along records."""
    if not observer.tracking:  # then whole records are quicker than their steps
        return observer.estimate(y, u), observer.estimate_covariance(y, u)
    x_hat, covariance = [observer.reset(y[0])], [observer.covariance]
    for k in range(1, len(y)):
        x_hat.append(observer.step(y[k], None if u is None else u[k - 1]))
        covariance.append(observer.covariance)
    return np.array(x_hat), np.array(covariance)


def _judged(
    x: np.ndarray, estimates: Iterator[tuple[np.ndarray, np.ndarray]], spans: tuple[slice, ...]
) -> list[Coverage]:
    """Judge estimates and covariances, chunk by chunk of the trajectories."""
    distances: list[np.ndarray] = []
    ratios: list[np.ndarray] = []
    for rows, (x_hat, covariance) in zip(_chunks(x.shape[1]), estimates, strict=True):
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
