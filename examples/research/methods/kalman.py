"""Kalman filters with the exact model as methods of the benchmark."""

from typing import Any, ClassVar

import numpy as np

from examples.research.methods.base import Arrays, Configuration, Method, Task
from examples.research.methods.unscented import UnscentedKalmanFilter
from kkl_gym.system import System
from observers.estimator import Estimator
from training.evaluation.levels import Level
from training.kalman import ExtendedKalmanFilter, measurement_covariance

# Levels of the white process noise that a filter assumes, in multiples of each state's scale per square root of
# System.pace. The trajectories have no process noise; the level accounts for the filter's errors of linearisation. This
# white noise is not the bounded process noise of environments.
DIFFUSION = (1e-4, 1e-3, 1e-2)


def diffusion_intensity(trained: Arrays, system: System) -> np.ndarray:
    """Return Q, (nx, nx), per second, for the chosen level of diffusion."""
    return np.diag((trained["diffusion"] * np.array(system.scale)) ** 2 / system.pace)


class EKF(Method[Arrays]):
    """Extended Kalman filter with the exact equations and noise level; validation runs choose its level of DIFFUSION.

    It starts with the mean and covariance of the system's starts in X.
    """

    name: ClassVar[str] = "ekf"
    label: ClassVar[str] = "EKF"
    filter: ClassVar[type[ExtendedKalmanFilter]] = ExtendedKalmanFilter

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Return the three levels of DIFFUSION, the filter's process noise."""
        return tuple({"diffusion": level} for level in DIFFUSION)

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """Return the level of diffusion; there is nothing to learn."""
        return {"diffusion": np.array([configuration["diffusion"]])}

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """Return the filter for a level of measurement noise."""
        Q = diffusion_intensity(trained, system)
        R = measurement_covariance(system, noise)
        return self.filter(system, dt, Q=Q, R=R)


class UKF(EKF):
    """Unscented Kalman filter with the exact equations and noise level, tuned like the EKF."""

    name: ClassVar[str] = "ukf"
    label: ClassVar[str] = "UKF"
    filter: ClassVar[type[ExtendedKalmanFilter]] = UnscentedKalmanFilter
