"""Control tasks: hold an equilibrium with a bounded input, seen through a noisy output."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gymnasium.vector import AutoresetMode

from kkl_gym import KKLVectorEnv, VectorActionRepeat
from kkl_gym.system import Box, System
from kkl_gym.wrappers.vector import VectorEnv
from observers.checks import is_finite

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
        """What ``gym.make`` is told to make the system's environment as the task has it."""
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
