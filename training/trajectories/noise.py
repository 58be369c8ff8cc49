"""Process noise that disturbs a system, and measurement noise on its outputs.

Where noise enters training. Process noise enters the trajectories that :mod:`training.trajectories.record` simulates,
for input-aware maps. Measurement noise enters the filter's state in :mod:`training.maps.inverse`, when a batch is
drawn, with the covariance that :mod:`training.maps.coordinates` gives it. In closed loop both enter the simulation
itself, in :mod:`training.trajectories.closed_loop`, because the controller acts on what the observer makes of them.
"""

from collections.abc import Sequence

import numpy as np

from kkl_gym.system import System

# Where maps are told a level of measurement noise for each of several outputs: the part of their training in which all
# have the same part of their largest levels. In the other part each has a level of its own, which may be none.
ALIKE = 0.5


def draw_process_noise(
    system: System, level: float | np.ndarray, *, n: int, steps: int, rng: np.random.Generator
) -> np.ndarray:
    """Process noise (steps, n, nx) of levels (n,), uniform in a box and held over each sampling interval."""
    bound = np.multiply.outer(level, system.scale)
    return np.asarray(bound * rng.uniform(-1.0, 1.0, (steps, n, system.nx)))


def noisy_output(
    system: System, x: np.ndarray, *, measurement_noise: float | Sequence[float], rng: np.random.Generator
) -> np.ndarray:
    """Measure states (..., nx) with Gaussian noise of this standard deviation, of all outputs or each; (..., ny)."""
    return system.output(x) + np.asarray(measurement_noise) * rng.standard_normal((*x.shape[:-1], system.ny))
