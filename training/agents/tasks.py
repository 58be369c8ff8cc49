"""Tasks of agents (an environment, its measured entries, the time between actions), and scores in systems' tasks."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym import ENV_IDS, OWN_ID, SYSTEMS, get_system
from kkl_gym.memory import output_time_constants
from kkl_gym.signals import Angles, angle_entries
from kkl_gym.system import Box, System
from observers.checks import LARGEST, flag, integer, is_finite, real_array, shown
from observers.names import matching
from training.evaluation.levels import Level

MAX_SAMPLES = 100_000  # largest number of samples in an episode, all of which are stored
MAX_FRAMES = 1_000  # largest number of stacked observations, also for tasks in files, which are untrusted
TOLERANCE = 0.2  # largest norm of (x - target) / System.scale that counts as a success


@dataclass(frozen=True)
class Task:
    """An environment and the entries of its observations that agents may see.

    A system's environment measures y, so ``measured``, ``hidden`` and ``angles`` are unused. ``hidden`` None stands
    for all entries that are not measured. ``gym.make`` takes ``env_id`` and ``env_kwargs``. An action lasts ``repeat``
    samples; ``time_constants`` and ``frames`` are in actions. ``weights``: see :meth:`kkl_gym.KKLMemory.learn_weights`.
    """

    env_id: str
    measured: tuple[int, ...] = ()
    hidden: tuple[int, ...] | None = None
    measurement_noise: Level = 0.0
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    repeat: int = 1
    time_constants: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    frames: int = 8
    past_actions: bool = True
    angles: Angles = ()
    weights: Sequence[Sequence[float]] | np.ndarray | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.env_id, str):
            raise ValueError(f"env_id must be a string, got {shown(self.env_id)}")
        # JSON turns tuples into lists, and a task that is read from a file must equal the task that was written.
        try:
            object.__setattr__(self, "env_kwargs", json.loads(json.dumps(dict(self.env_kwargs))))
        except (TypeError, ValueError) as error:
            raise ValueError(f"env_kwargs must be JSON, got {shown(self.env_kwargs)}: {error}") from None
        for name in ("measured", "hidden"):
            if (given := getattr(self, name)) is not None:
                entries = tuple(integer(f"an entry of {name}", entry, 0) for entry in given)
                empty = name == "measured" and not entries and self.system is None
                if len(set(entries)) < len(entries) or empty:
                    raise ValueError(f"{name} must name entries of the observation, each once, got {shown(given)}")
                object.__setattr__(self, name, entries)
        object.__setattr__(self, "angles", angle_entries(self.angles))
        if self.system is None:
            if not is_finite(self.measurement_noise) or not 0 <= self.measurement_noise < LARGEST:  # type: ignore[operator]
                raise ValueError(f"measurement_noise must be one number from 0 on, got {shown(self.measurement_noise)}")
            object.__setattr__(self, "measurement_noise", float(self.measurement_noise))  # type: ignore[arg-type]
            if self.repeat != 1:
                raise ValueError(f"repeat must be 1: only environments of systems repeat actions, not {self.env_id}")
        else:
            if isinstance(self.measurement_noise, list):
                object.__setattr__(self, "measurement_noise", tuple(self.measurement_noise))
            limit = integer("max_episode_steps", self.env_kwargs.get("max_episode_steps"), 1, MAX_SAMPLES)
            object.__setattr__(self, "repeat", integer("repeat", self.repeat, 1, limit))
        object.__setattr__(self, "time_constants", output_time_constants("time_constants", self.time_constants))
        object.__setattr__(self, "past_actions", flag("past_actions", self.past_actions))
        object.__setattr__(self, "frames", integer("frames", self.frames, 1, MAX_FRAMES))
        if self.weights is not None:
            object.__setattr__(self, "weights", real_array("weights", self.weights).tolist())

    @property
    def system(self) -> str | None:
        """Name of the system whose environment this is, or None for another environment."""
        if self.env_id == OWN_ID:
            return str(self.env_kwargs.get("system"))
        return next((name for name, env_id in ENV_IDS.items() if env_id == self.env_id), None)

    @property
    def name(self) -> str:
        """Name of the system or the environment, for folders and tables."""
        return self.env_id.replace("/", "-") if self.system is None else get_system(self.system).name

    @property
    def steps(self) -> int:
        """Number of actions in an episode of a system."""
        return int(self.env_kwargs["max_episode_steps"]) // self.repeat

    @property
    def without_noise(self) -> "Task":
        """The same task without measurement noise."""
        return replace(self, measurement_noise=0.0)


def control_task(
    system: str,
    measurement_noise: Level = 0.5,
    *,
    period: float = 0.05,
    duration: float = 20.0,
    start_box: Box | None = None,
    dt: float = 0.01,
) -> Task:
    """Return the task to bring a system to its target and hold it there. Times are in seconds."""
    for name, time, unit in (("period", period, dt), ("duration", duration, period)):
        if not (is_finite(time) and is_finite(unit)) or not 0 < unit <= time:
            raise ValueError(f"a task needs 0 < dt <= period <= duration, got {dt}, {period} and {duration}")
        if abs(time / unit - round(time / unit)) > 1e-6:
            raise ValueError(f"{name} = {time} s must be a whole multiple of {unit} s")
    repeat = round(period / dt)
    options = {"dt": dt, "start_box": start_box, "max_episode_steps": repeat * round(duration / period)}
    own = {} if system in ENV_IDS else {"system": system}
    env_id = ENV_IDS.get(system, OWN_ID)
    return Task(env_id, measurement_noise=measurement_noise, env_kwargs=own | options, repeat=repeat)


TASKS: dict[str, Task] = {
    # The target is marginally stable: an agent that does not know the state cannot remove energy.
    "reverse_duffing": control_task("reverse_duffing", period=0.1),
    # The target is unstable. Starts have |x1| < 3: farther out, motions stay on a slow manifold under any input.
    "van_der_pol": control_task("van_der_pol", start_box=((-3, 3), (-6, 6))),
    "rossler": control_task("rossler", period=0.1, duration=30.0),
    "lorenz": control_task("lorenz", duration=5.0),
}
PREFERRED = {"reverse_duffing": "sac"}  # default algorithms; all other systems have ppo

# Positions are measured and velocities are hidden, as in rl-zoo3's tasks. Observers estimate all hidden entries except
# the double pendulum's constraint force.
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


def get_task(name: str, measurement_noise: Level | None = None, **changes: Any) -> Task:
    """Return the task of a system, of a script's class or of an environment id, with ``changes`` of its fields."""
    name = matching(name, SYSTEMS) or name
    if name not in SYSTEMS and (name in gym.registry or re.search(r"-v\d+$", name)):
        if ":" not in name:
            try:
                gym.spec(name)
            except gym.error.Error as error:
                raise ValueError(f"unknown environment {name!r}: {error}") from error
        known = HIDDEN_VELOCITIES.get(name)
        if known is None and not changes.get("measured"):
            known_ids = ", ".join(HIDDEN_VELOCITIES)
            raise ValueError(f"name the measured entries of {name} (--measured 0,1); only {known_ids} have defaults")
        task = known if known is not None and not changes.get("measured") else Task(name, tuple(changes["measured"]))
        return replace(task, **{"measurement_noise": measurement_noise or 0.0, **changes})
    system = get_system(name)
    if given := {"measured", "hidden", "angles"} & changes.keys():
        raise ValueError(f"{', '.join(sorted(given))}: only for environments; the system {name} measures y")
    task = task_of(system, name)
    if measurement_noise is not None:
        changes["measurement_noise"] = measurement_noise
    return replace(task, **{**changes, "env_kwargs": {**task.env_kwargs, **changes.get("env_kwargs", {})}})


def task_of(system: System, name: str | None = None) -> Task:
    """Return the task of a system; ``name`` names the class of a system that does not ship."""
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs for an agent to act on")
    dt = system.dt
    return TASKS.get(system.name) or control_task(
        name or system.name, system.measurement_noise, period=5 * dt, duration=2000 * dt, dt=dt
    )


def deviation(system: System, x: np.ndarray) -> np.ndarray:
    """Return (x - target) / scale. Shapes: ``x`` (..., nx); returns (..., nx)."""
    out: np.ndarray = (x - np.array(system.target)) / np.array(system.scale)
    return out


def scores(system: System, x: np.ndarray) -> np.ndarray:
    """Return scores (n,) of ``x`` (steps, n, nx): time means of exp(-4 c) - 1, c = mean(((x - target) / scale)^2)."""
    c = np.square(deviation(system, x)).mean(-1)
    return np.asarray(np.expm1(-4.0 * c).mean(0))


def successes(system: System, x: np.ndarray) -> np.ndarray:
    """Return (n,) whether ``x`` (steps, n, nx) is within ``TOLERANCE`` of the target in the last fifth of the steps."""
    late = x[-max(1, round(0.2 * len(x))) :]
    return np.asarray((np.linalg.norm(deviation(system, late), axis=-1) <= TOLERANCE).all(0))
