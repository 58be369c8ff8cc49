"""Kalman filters that know the equations of motion: what a control engineer would try first."""

from typing import Any, ClassVar

import numpy as np

from kkl_gym.system import Components, System
from training.kalman import NOISE_FLOOR, ExtendedKalmanFilter, UnscentedFilters, unknown_start
from training.methods.base import Arrays, CausalObserver, Configuration, Method, Task

# Process noise, in multiples of each state's scale per square root of a second: what stands for the filters'
# own errors of linearisation, for there is none in the trajectories.
PROCESS_NOISE = (1e-3, 1e-2, 1e-1)


class EKF(Method[Arrays]):
    """Extended Kalman filter with the exact model and noise level; its process noise is chosen on validation.

    The start is unknown to it: the centre of X, with the covariance of a uniform draw from X.
    """

    name: ClassVar[str] = "ekf"
    label: ClassVar[str] = "EKF"

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Three levels of process noise."""
        return tuple({"process_noise": level} for level in PROCESS_NOISE)

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """Nothing to learn."""
        return {"process_noise": np.array([configuration["process_noise"]])}

    def observer(self, trained: Arrays, system: System, dt: float, noise: float) -> CausalObserver:
        """The filter, told the noise level."""
        Q = np.diag((trained["process_noise"] * np.array(system.scale)) ** 2)
        R = max(noise, NOISE_FLOOR) ** 2 * np.eye(system.ny)
        return ExtendedKalmanFilter(self.model(system), dt, Q=Q, R=R)

    def model(self, system: System) -> System:
        """The equations that the filter believes in."""
        return system


class WrongEKF(EKF):
    """The same filter, tuned the same way, with a model that is 10 % wrong."""

    name: ClassVar[str] = "ekf-wrong"
    label: ClassVar[str] = "EKF, model 10 % off"

    def model(self, system: System) -> System:
        """Every parameter 10 % too large; a system without parameters runs 10 % too fast."""
        if system.parameters:
            return system.replace({name: 1.1 * value for name, value in system.parameters.items()})
        return faster(system, 1.1)


class UntunedEKF(EKF):
    """The exact model with the covariances that filterpy starts from: P, Q (per sample) and R are the identity."""

    name: ClassVar[str] = "ekf-untuned"
    label: ClassVar[str] = "EKF, untuned"

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """The one that nobody chose."""
        return ({},)

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """Nothing to learn."""
        return {"process_noise": np.array([1.0])}

    def observer(self, trained: Arrays, system: System, dt: float, noise: float) -> CausalObserver:
        """The filter."""
        x0, _ = unknown_start(system)
        eye = np.eye(system.nx)
        return ExtendedKalmanFilter(system, dt, Q=eye / dt, R=np.eye(system.ny), start=(x0, eye))


class UKF(EKF):
    """filterpy's unscented Kalman filter with the exact model and noise level, tuned as the EKF is."""

    name: ClassVar[str] = "ukf"
    label: ClassVar[str] = "UKF"
    trajectories: ClassVar[int | None] = 10

    def observer(self, trained: Arrays, system: System, dt: float, noise: float) -> CausalObserver:
        """One filter for each trajectory."""
        Q = np.diag((trained["process_noise"] * np.array(system.scale)) ** 2)
        R = max(noise, NOISE_FLOOR) ** 2 * np.eye(system.ny)
        return UnscentedFilters(system, dt, Q=Q, R=R)


def faster(system: System, factor: float) -> System:
    """The system with time running faster."""

    class Faster(type(system)):  # type: ignore[misc]
        name = f"{system.name}-faster"

        def f(self, x: Components) -> Components:
            return [factor * fi for fi in system.f(x)]

        def rate(self, x: Components) -> Any:
            return factor * system.rate(x)

    return Faster()
