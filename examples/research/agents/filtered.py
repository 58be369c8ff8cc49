"""Agents on the estimates of an extended Kalman filter that knows the equations."""

import numpy as np

from kkl_gym import get_system
from kkl_gym.wrappers.estimator import Estimates
from kkl_gym.wrappers.vector import VectorEnv, VectorEstimate, plant_of
from training.agents.environments import vector
from training.agents.information import FeatureObservation, Information
from training.agents.tasks import Task, deviation
from training.kalman import ExtendedKalmanFilter, measurement_covariance

# Root of the spectral density of the process noise that the filters assume, as a multiple of scale / sqrt(pace).
PROCESS_NOISE = 1e-2


def kalman_filters(env: VectorEnv) -> Estimates:
    """Make, for VectorEstimate, extended Kalman filters that know the model, the noise level and the input."""
    plant = plant_of(env)
    system = plant.system
    Q = np.diag((PROCESS_NOISE * np.array(system.scale)) ** 2 / system.pace)
    R = measurement_covariance(system, plant.measurement_noise)
    return Estimates(ExtendedKalmanFilter(system, plant.dt, Q=Q, R=R), plant.state_space)


def show_filtered(task: Task, information: Information, rows: int, *, observer: str | None = None) -> VectorEnv:
    """Make environments of a system's task in which the agent sees the estimates of extended Kalman filters."""
    assert task.system is not None
    system = get_system(task.system)
    env = vector(task, rows, lambda env: VectorEstimate(env, kalman_filters(env)))
    return FeatureObservation(env, lambda at: deviation(system, at["x_hat"]), system.nx, ["x_hat"])
