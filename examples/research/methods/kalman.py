"""Kalman filters with the exact model, or a wrong one, as methods of the benchmark."""

from typing import Any, ClassVar

import numpy as np

from examples.research.methods.base import Arrays, Configuration, Method, Task, WrongParameters
from examples.research.methods.unscented import UnscentedKalmanFilter
from kkl_gym.system import System
from observers.estimator import Estimator
from training.evaluation.levels import Level
from training.kalman import ExtendedKalmanFilter, measurement_covariance
from training.sources.simulated import unknown_start

# Levels of the process noise that a filter assumes, in multiples of each state's scale per square root of the pace:
# white noise, unlike the bounded process noise of the environments. It stands for the filters' own errors of
# linearisation, for there is none in the trajectories.
DIFFUSION = (1e-4, 1e-3, 1e-2)
WRONG_DIFFUSION = (1e-3, 1e-2, 1e-1)  # which has to make up for a wrong model as well


def diffusion_intensity(trained: Arrays, system: System) -> np.ndarray:
    """Q, (nx, nx), per second, of the level of diffusion that was chosen."""
    return np.diag((trained["diffusion"] * np.array(system.scale)) ** 2 / system.pace)


class EKF(Method[Arrays]):
    """Extended Kalman filter with the exact model and noise level; its diffusion is chosen on validation.

    The start is unknown to it: the centre of X, with the covariance of a uniform draw from X.
    """

    name: ClassVar[str] = "ekf"
    label: ClassVar[str] = "EKF"
    filter: ClassVar[type[ExtendedKalmanFilter]] = ExtendedKalmanFilter
    diffusion: ClassVar[tuple[float, ...]] = DIFFUSION

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Three levels of diffusion, in multiples of the scale per square root of a second of its pace."""
        return tuple({"diffusion": level} for level in self.diffusion)

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """Nothing to learn."""
        return {"diffusion": np.array([configuration["diffusion"]])}

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """The filter for a noise level."""
        Q = diffusion_intensity(trained, system)
        R = measurement_covariance(system, noise)
        return self.filter(self.believed(system), dt, Q=Q, R=R)


class UKF(EKF):
    """Unscented Kalman filter with the exact model and noise level, tuned as the EKF is."""

    name: ClassVar[str] = "ukf"
    label: ClassVar[str] = "UKF"
    filter: ClassVar[type[ExtendedKalmanFilter]] = UnscentedKalmanFilter


class WrongEKF(WrongParameters, EKF):
    """The same filter, tuned the same way, with every parameter 10 % too large."""

    name: ClassVar[str] = "ekf-wrong"
    label: ClassVar[str] = "EKF, model 10 % off"
    diffusion: ClassVar[tuple[float, ...]] = WRONG_DIFFUSION


class UntunedEKF(Method[Arrays]):
    """The exact model with the covariances that filterpy starts from: P, Q (per sample) and R are the identity."""

    name: ClassVar[str] = "ekf-untuned"
    label: ClassVar[str] = "EKF, untuned"

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """Nothing to learn."""
        return {}

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """The filter, whatever the noise."""
        x0, _ = unknown_start(system)
        eye = np.eye(system.nx)
        return ExtendedKalmanFilter(system, dt, Q=eye / dt, R=np.eye(system.ny), start=(x0, eye))
