"""Control tasks: hold an equilibrium with a bounded input, seen through a noisy output."""

from collections.abc import Callable
from dataclasses import dataclass

from gymnasium.vector import AutoresetMode

from kkl_gym import KKLVectorEnv, VectorActionRepeat
from kkl_gym.system import Box
from kkl_gym.wrappers.vector import VectorEnv


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
