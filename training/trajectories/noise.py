"""Process noise that disturbs a system, and measurement noise on its outputs.

Where noise enters training: process noise here, into the trajectories that :mod:`training.trajectories.record`
simulates; measurement noise in :mod:`training.maps.samplers`, into the filter's state, with the covariance that
:mod:`training.filter_noise` gives it.
"""

from typing import Any

import numpy as np

from kkl_gym.system import System


def draw_process_noise(system: System, level: Any, n: int, steps: int, rng: np.random.Generator) -> np.ndarray:
    """w held over each sample, (steps, n, nx): uniform up to a level (one, or (n,)) in multiples of the scale per s."""
    bound = np.multiply.outer(level, system.scale)
    return np.asarray(bound * rng.uniform(-1.0, 1.0, (steps, n, system.nx)))


def noisy_output(system: System, x: np.ndarray, measurement_noise: float, rng: np.random.Generator) -> np.ndarray:
    """h(x) at states (..., nx) with Gaussian noise of this standard deviation on every sample, (..., ny)."""
    return system.output(x) + measurement_noise * rng.standard_normal((*x.shape[:-1], system.ny))
