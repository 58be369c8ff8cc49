"""What agents are to do, and how well they do it."""

from dataclasses import replace

import numpy as np

from kkl_gym import get_system
from kkl_gym.system import System
from training.evaluation.levels import Level
from training.systems import PROFILES, ControlTask, profile

TASKS: dict[str, ControlTask] = {name: found.task for name, found in PROFILES.items() if found.task}


def get_task(name: str | System, measurement_noise: Level | None = None) -> ControlTask:
    """The task of a system, with another noise level if one is given."""
    system = get_system(name)
    if not system.nu:
        raise ValueError(f"{name} has no inputs for an agent to act on")
    task = profile(system).task or ControlTask(
        name, system.measurement_noise, period=5 * system.dt, duration=2000 * system.dt, dt=system.dt
    )
    return task if measurement_noise is None else replace(task, measurement_noise=measurement_noise)


def deviation(system: System, x: np.ndarray) -> np.ndarray:
    """(x - target) / scale. Shapes: ``x`` (..., nx); returns (..., nx)."""
    out: np.ndarray = (x - np.array(system.target)) / np.array(system.scale)
    return out


def scores(system: System, x: np.ndarray) -> np.ndarray:
    """Scores (n,) of ``x`` (steps, n, nx): mean over time of exp(-4 c) - 1, c = mean(((x - target) / scale)^2)."""
    c = np.square(deviation(system, x)).mean(-1)
    return np.asarray(np.expm1(-4.0 * c).mean(0))


def successes(task: ControlTask, x: np.ndarray) -> np.ndarray:
    """Whether ``x`` (steps, n, nx) stay within the task's tolerance of the target for their last fifth."""
    late = x[-max(1, round(0.2 * len(x))) :]
    distance = np.linalg.norm(deviation(get_system(task.system), late), axis=-1)
    return np.asarray((distance <= task.tolerance).all(0))
