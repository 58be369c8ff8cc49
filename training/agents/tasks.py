"""Control tasks: hold an equilibrium with a bounded input, seen through a noisy output."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from gymnasium.vector import AutoresetMode

from kkl_gym import KKLVectorEnv, VectorActionRepeat, get_system
from kkl_gym.system import Box, System
from kkl_gym.vector_wrappers import VectorEnv


@dataclass(frozen=True)
class ControlTask:
    """Bring a system to its target and hold it there.

    system : a shipped name, "module:Class" or "script.py:Class".
    measurement_noise : standard deviation on every sample of y.
    period : seconds for which an action is held; the observer sees every sample within.
    duration : of an episode, in seconds.
    start_box : where episodes start; None is the training box.
    tolerance : success is |(x - target) / scale| within this throughout the last fifth of the episode.
    dt : sampling interval in seconds.
    """

    system: str
    measurement_noise: float = 0.5
    period: float = 0.05
    duration: float = 20.0
    start_box: Box | None = None
    tolerance: float = 0.2
    dt: float = 0.01

    def __post_init__(self) -> None:
        if not self.tolerance > 0 or not 0 < self.dt <= self.period <= self.duration:
            raise ValueError(f"a task needs tolerance > 0 and 0 < dt <= period <= duration, got {self}")
        for name, time, unit in (("period", self.period, self.dt), ("duration", self.duration, self.period)):
            if abs(time / unit - round(time / unit)) > 1e-6:
                raise ValueError(f"{name} = {time} s must be a whole multiple of {unit} s")

    @property
    def repeat(self) -> int:
        """Samples in a period."""
        return round(self.period / self.dt)

    @property
    def steps(self) -> int:
        """Actions in an episode."""
        return round(self.duration / self.period)

    def make(
        self,
        num_envs: int,
        wrap: Callable[[VectorEnv], VectorEnv] | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> VectorEnv:
        """The task as a vector environment that acts once a period.

        Parameters
        ----------
        num_envs : rows.
        wrap : what goes around the environment at its own sampling interval, such as
            :class:`kkl_gym.KKLVectorObservation`; None shows the state.
        autoreset_mode : as for :class:`kkl_gym.VectorActionRepeat`.
        """
        env: VectorEnv = KKLVectorEnv(
            self.system,
            num_envs,
            dt=self.dt,
            measurement_noise=self.measurement_noise,
            start_box=self.start_box,
            max_episode_steps=self.steps * self.repeat,
            autoreset_mode=AutoresetMode.DISABLED,
        )
        return VectorActionRepeat(env if wrap is None else wrap(env), self.repeat, autoreset_mode)


# Chosen so that what an agent knows of the state decides: Duffing is marginally stable, Van der Pol's target is
# unstable (and beyond |x1| = 3 a slow manifold holds it for a while, whatever one does), Lorenz's input is weak.
TASKS: dict[str, ControlTask] = {
    "reverse_duffing": ControlTask("reverse_duffing", period=0.1),
    "van_der_pol": ControlTask("van_der_pol", start_box=((-3, 3), (-6, 6))),
    "rossler": ControlTask("rossler", period=0.1, duration=30.0),
    "lorenz": ControlTask("lorenz", duration=5.0),
}


def get_task(name: str, measurement_noise: float | None = None) -> ControlTask:
    """A task by its system's name, with another noise level if one is given; raises ValueError on an unknown name."""
    if name not in TASKS:
        raise ValueError(f"no control task for {name!r}; there are {', '.join(TASKS)}")
    task = TASKS[name]
    return task if measurement_noise is None else replace(task, measurement_noise=measurement_noise)


def deviation(system: System, x: np.ndarray) -> np.ndarray:
    """(x - target) / scale, of the shape of x, (..., nx)."""
    out: np.ndarray = (x - np.array(system.target)) / np.array(system.scale)
    return out


def scores(system: System, x: np.ndarray) -> np.ndarray:
    """mean over time of exp(-4 c) - 1 in [-1, 0], 0 being best, c = mean(((x - target) / scale)^2).

    x : states, (steps, n, nx). Returns (n,).
    """
    c = np.square(deviation(system, x)).mean(-1)
    return np.asarray(np.expm1(-4.0 * c).mean(0))


def successes(task: ControlTask, x: np.ndarray) -> np.ndarray:
    """Whether the last fifth of x, (steps, n, nx), stays within the task's tolerance of the target; boolean (n,)."""
    late = x[-max(1, round(0.2 * len(x))) :]
    distance = np.linalg.norm(deviation(get_system(task.system), late), axis=-1)
    return np.asarray((distance <= task.tolerance).all(0))
