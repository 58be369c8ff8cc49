"""Agents on the estimates of an extended Kalman filter that knows the equations."""

from collections.abc import Mapping

import numpy as np

from kkl_gym import get_system
from kkl_gym.wrappers.vector import VectorEnv, VectorEstimate, plant_of
from training.agents.environments import vector
from training.agents.information import FeatureObservation, Information
from training.agents.observing import Estimation
from training.agents.tasks import deviation
from training.kalman import ExtendedKalmanFilter, measurement_covariance
from training.systems import Task

PROCESS_NOISE = 1e-2  # in multiples of each state's scale per square root of a second of its pace


class KalmanFilters:
    """Extended Kalman filters that know model, noise level and input, as VectorEstimate drives them."""

    def __init__(self, env: VectorEnv) -> None:
        plant = plant_of(env)
        system = plant.system
        Q = np.diag((PROCESS_NOISE * np.array(system.scale)) ** 2 / system.pace)
        R = measurement_covariance(system, plant.measurement_noise)
        self._filters = ExtendedKalmanFilter(system, plant.dt, Q=Q, R=R)
        self.space = plant.state_space
        self.advance = self._filters.advance

    def reset(self, y0: np.ndarray, x0: np.ndarray) -> None:
        """Begin with the first samples, (n, ny); these filters do not use the states x0, (n, nx)."""
        self._filters.reset(y0)

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray) -> None:
        """Restart some rows with their first samples."""
        self._filters.restart(y0, rows)

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Report the estimates, (n, nx), of all rows or of those in a mask."""
        return {"x_hat": self._filters.decode(rows)}

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the estimates of a report."""
        return report["x_hat"]


def show_filtered(task: Task, information: Information, rows: int, observer: str | None) -> VectorEnv:
    """Make a system's task in which the agent sees the estimates of extended Kalman filters."""
    assert task.system is not None
    system = get_system(task.system)
    env = vector(task, rows, lambda env: VectorEstimate(env, KalmanFilters(env)))
    return FeatureObservation(env, lambda at: deviation(system, at["x_hat"]), system.nx, ["x_hat"])


EKF = Estimation(show=show_filtered)
