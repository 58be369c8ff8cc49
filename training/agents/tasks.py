"""What agents are to do, and how well they do it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from kkl_gym import KKLVectorEnv, VectorActionRepeat, get_system
from kkl_gym.system import Box, System
from kkl_gym.wrappers.vector import VectorEnv
from observers.checks import is_finite
from training.evaluation.levels import Level

MOST_SAMPLES = 100_000  # of an episode: all of them are kept while it is played


@dataclass(frozen=True)
class ControlTask:
    """Bring a system to its target and hold it there."""

    system: str | System
    measurement_noise: float | tuple[float, ...] = 0.5
    period: float = 0.05
    duration: float = 20.0
    start_box: Box | None = None
    tolerance: float = 0.2
    dt: float = 0.01

    def __post_init__(self) -> None:
        for name in ("period", "duration", "tolerance", "dt"):
            if not is_finite(getattr(self, name)):
                raise ValueError(f"a task's {name} must be a finite number, got {getattr(self, name)!r}")
        if not self.tolerance > 0 or not 0 < self.dt <= self.period <= self.duration:
            raise ValueError(f"a task needs tolerance > 0 and 0 < dt <= period <= duration, got {self}")
        if self.duration / self.dt > MOST_SAMPLES:
            raise ValueError(
                f"an episode has at most {MOST_SAMPLES} samples, got {self.duration} s at dt = {self.dt} s"
            )
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

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of ``gym.make`` for the system's environment as the task has it."""
        return {
            "dt": self.dt,
            "measurement_noise": self.measurement_noise,
            "start_box": self.start_box,
            "max_episode_steps": self.steps * self.repeat,
        }

    def make(
        self,
        num_envs: int,
        wrap: Callable[[VectorEnv], VectorEnv] | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> VectorEnv:
        """The task as a vector environment that acts once a period."""
        env: VectorEnv = KKLVectorEnv(self.system, num_envs, **self.options, autoreset_mode=AutoresetMode.DISABLED)
        return VectorActionRepeat(env if wrap is None else wrap(env), self.repeat, autoreset_mode)


TASKS: dict[str, ControlTask] = {
    # Marginally stable: an agent that does not know the state cannot take energy out.
    "reverse_duffing": ControlTask("reverse_duffing", period=0.1),
    # The target is unstable. Starts keep to |x1| < 3: beyond it a slow manifold holds the motion under any input.
    "van_der_pol": ControlTask("van_der_pol", start_box=((-3, 3), (-6, 6))),
    "rossler": ControlTask("rossler", period=0.1, duration=30.0),
    "lorenz": ControlTask("lorenz", duration=5.0),  # the input is weak
}
PREFERRED = {"reverse_duffing": "sac"}  # algorithm; ppo for all others


def get_task(name: str | System, measurement_noise: Level | None = None) -> ControlTask:
    """The task of a system, with another noise level if one is given."""
    system = get_system(name)
    if not system.nu:
        raise ValueError(f"{name} has no inputs for an agent to act on")
    task = TASKS.get(system.name) or ControlTask(
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
