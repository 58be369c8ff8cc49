"""What agents are to do, and how well they do it."""

from dataclasses import replace

import numpy as np

from kkl_gym import get_system
from kkl_gym.system import System
from training.evaluation.levels import Level
from training.systems import PROFILES, ControlTask, profile

TASKS: dict[str, ControlTask] = {name: found.task for name, found in PROFILES.items() if found.task}


def get_task(name: str | System, measurement_noise: Level | None = None) -> ControlTask:
    """The task of a system, with another noise level if one is given.

    Parameters
    ----------
    name : str or System
        A shipped system, ``"script.py:Class"``, or the system itself.
    measurement_noise : float or tuple of float, length ny, optional
        Standard deviation of the noise on each sample of y, of all outputs or each.

    Returns
    -------
    ControlTask
        That of the system's profile, or one with the defaults.

    Raises
    ------
    ValueError
        On an unknown name, or if the system has no inputs.
    """
    system = get_system(name)
    if not system.nu:
        raise ValueError(f"{name} has no inputs for an agent to act on")
    task = profile(system).task or ControlTask(
        name, system.measurement_noise, period=5 * system.dt, duration=2000 * system.dt, dt=system.dt
    )
    return task if measurement_noise is None else replace(task, measurement_noise=measurement_noise)


def deviation(system: System, x: np.ndarray) -> np.ndarray:
    """(x - target) / scale.

    Parameters
    ----------
    system : System
        Whose target and scale are meant.
    x : ndarray, shape (..., nx)
        States.

    Returns
    -------
    ndarray, shape (..., nx)
        Zero at the target.
    """
    out: np.ndarray = (x - np.array(system.target)) / np.array(system.scale)
    return out


def scores(system: System, x: np.ndarray) -> np.ndarray:
    """Scores of episodes: mean over time of exp(-4 c) - 1, where c = mean(((x - target) / scale)^2).

    Parameters
    ----------
    system : System
        Whose target and scale are meant.
    x : ndarray, shape (steps, n, nx)
        States.

    Returns
    -------
    ndarray, shape (n,)
        In [-1, 0]; 0 is best.
    """
    c = np.square(deviation(system, x)).mean(-1)
    return np.asarray(np.expm1(-4.0 * c).mean(0))


def successes(task: ControlTask, x: np.ndarray) -> np.ndarray:
    """Whether episodes stay within the task's tolerance of the target for their last fifth.

    Parameters
    ----------
    task : ControlTask
        What was to be done.
    x : ndarray, shape (steps, n, nx)
        States.

    Returns
    -------
    ndarray of bool, shape (n,)
        One for each episode.
    """
    late = x[-max(1, round(0.2 * len(x))) :]
    distance = np.linalg.norm(deviation(get_system(task.system), late), axis=-1)
    return np.asarray((distance <= task.tolerance).all(0))
