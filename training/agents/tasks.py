"""Which tasks there are, and how well agents do those of systems."""

import re
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym import ENV_IDS, SYSTEMS, get_system
from kkl_gym.system import System
from training.systems import PROFILES, Task, control_task, profile

TASKS: dict[str, Task] = {name: known.task for name, known in PROFILES.items() if known.task}
TOLERANCE = 0.2  # distance from the target over the scale, within which an agent holds it

# Positions are measured and velocities are not, as in rl-zoo3's tasks. ``hidden`` where an observer estimates less than
# all the rest: of the double pendulum not the forces of its constraints.
HIDDEN_VELOCITIES: dict[str, Task] = {
    task.env_id: task
    for task in (
        Task("Pendulum-v1", (0, 1)),
        Task("CartPole-v1", (0, 2)),
        Task("MountainCarContinuous-v0", (0,)),
        Task("LunarLander-v3", (0, 1, 4, 6, 7)),
        Task("InvertedPendulum-v5", (0, 1)),
        Task("InvertedDoublePendulum-v5", (0, 1, 2, 3, 4), hidden=(5, 6, 7)),
        Task("Reacher-v5", (0, 1, 2, 3, 4, 5, 8, 9)),
        Task("Hopper-v5", (0, 1, 2, 3, 4)),
        Task("HalfCheetah-v5", (0, 1, 2, 3, 4, 5, 6, 7)),
    )
}


def get_task(name: str, measurement_noise: float | tuple[float, ...] | None = None, **changes: Any) -> Task:
    """Return the task of a system, of a script's class or of any environment id, with changes of its fields."""
    name = next((system for system, env_id in ENV_IDS.items() if env_id == name), name)
    if name not in SYSTEMS and (name in gym.registry or re.search(r"-v\d+$", name)):
        known = HIDDEN_VELOCITIES.get(name)
        if known is None and not changes.get("measured"):
            raise ValueError(
                f"say what is measured of {name}, as in --measured 0,1; it is known of {', '.join(HIDDEN_VELOCITIES)}"
            )
        task = known if known is not None and not changes.get("measured") else Task(name, tuple(changes["measured"]))
        return replace(task, **{"measurement_noise": measurement_noise or 0.0, **changes})
    system = get_system(name)
    if given := {"measured", "hidden", "angles"} & changes.keys():
        raise ValueError(f"{', '.join(sorted(given))}: of the system {name} y is measured; these are for environments")
    task = task_of(system, name)
    if measurement_noise is not None:
        changes["measurement_noise"] = measurement_noise
    return replace(task, **{**changes, "env_kwargs": {**task.env_kwargs, **changes.get("env_kwargs", {})}})


def task_of(system: System, name: str | None = None) -> Task:
    """Return the task of a system, whose ``name`` imports it if it does not ship."""
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs for an agent to act on")
    dt = system.dt
    return profile(system).task or control_task(
        name or system.name, system.measurement_noise, period=5 * dt, duration=2000 * dt, dt=dt
    )


def deviation(system: System, x: np.ndarray) -> np.ndarray:
    """(x - target) / scale. Shapes: ``x`` (..., nx); returns (..., nx)."""
    out: np.ndarray = (x - np.array(system.target)) / np.array(system.scale)
    return out


def scores(system: System, x: np.ndarray) -> np.ndarray:
    """Scores (n,) of ``x`` (steps, n, nx): mean over time of exp(-4 c) - 1, c = mean(((x - target) / scale)^2)."""
    c = np.square(deviation(system, x)).mean(-1)
    return np.asarray(np.expm1(-4.0 * c).mean(0))


def successes(system: System, x: np.ndarray) -> np.ndarray:
    """Whether ``x`` (steps, n, nx) stay within the tolerance of the target for their last fifth."""
    late = x[-max(1, round(0.2 * len(x))) :]
    return np.asarray((np.linalg.norm(deviation(system, late), axis=-1) <= TOLERANCE).all(0))
