"""Environments of others in which a part of the observation is hidden, and noise lies on the rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from kkl_gym.memory import output_time_constants
from observers.checks import LARGEST, flag, integer, is_finite, shown
from training.agents.information import STACKED
from training.rollouts.playing import make

MOST_FRAMES = 1_000  # which may come from a stranger's file
CLEAN, CLEAN_Y = "clean", "clean_y"  # of info, what was before noise was added


@dataclass(frozen=True)
class HiddenTask:
    """An environment, what is measured of it, and what an observer is to estimate."""

    env_id: str
    measured: tuple[int, ...]
    hidden: tuple[int, ...] | None = None
    measurement_noise: float = 0.0
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    time_constants: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    frames: int = STACKED
    past_actions: bool = True
    angles: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        for name in ("measured", "hidden"):
            if (given := getattr(self, name)) is not None:
                entries = tuple(integer(f"an entry of {name}", entry, 0) for entry in given)
                if len(set(entries)) < len(entries) or (name == "measured" and not entries):
                    raise ValueError(f"{name} must name entries of the observation, each once, got {shown(given)}")
                object.__setattr__(self, name, entries)
        object.__setattr__(self, "angles", _pairs(self.env_id, self.angles, self.measured or ()))
        if not is_finite(self.measurement_noise) or not 0 <= self.measurement_noise < LARGEST:
            raise ValueError(f"measurement_noise must be a number from 0 on, got {shown(self.measurement_noise)}")
        object.__setattr__(self, "measurement_noise", float(self.measurement_noise))
        object.__setattr__(self, "time_constants", output_time_constants("time_constants", self.time_constants))
        object.__setattr__(self, "past_actions", flag("past_actions", self.past_actions))
        object.__setattr__(self, "frames", integer("frames", self.frames, 1, MOST_FRAMES))

    @property
    def name(self) -> str:
        """For people and folders: the environment, and the noise if there is any."""
        noise = f" noise {self.measurement_noise:g}" if self.measurement_noise else ""
        return f"{self.env_id.replace('/', '-')}{noise}"

    @property
    def without_noise(self) -> "HiddenTask":
        """The same environment, measured exactly."""
        return replace(self, measurement_noise=0.0)

    def make(self, *, noisy: bool = True) -> gym.Env[np.ndarray, Any]:
        """Make the environment, with flat observations and noise on what is measured."""
        env = make(self.env_id, self.env_kwargs)
        if not (isinstance(env.observation_space, spaces.Box) and len(env.observation_space.shape) == 1):
            env = gym.wrappers.FlattenObservation(env)
        space = env.observation_space
        if not (isinstance(space, spaces.Box) and len(space.shape) == 1 and space.dtype != np.uint8):
            raise ValueError(f"an observation of {self.env_id} is no row of numbers: {shown(space)}")
        for entry in (*self.measured, *(self.hidden or ())):
            if entry >= space.shape[0]:
                raise ValueError(
                    f"there is no entry {entry} in an observation of {self.env_id}: it has 0 to {space.shape[0] - 1}"
                )
        if not self.measurement_noise:
            return env
        return MeasurementNoise(env, self.measured, self.measurement_noise if noisy else 0.0)

    def estimated(self, size: int) -> tuple[str, ...]:
        """What an observer estimates of an observation of some size."""
        name = f"info[{CLEAN}]" if self.measurement_noise else "obs"
        return tuple(f"{name}[{i}]" for i in self.estimated_entries(size))

    def estimated_entries(self, size: int) -> tuple[int, ...]:
        """Which entries of an observation of some size an observer estimates; under noise also what is measured."""
        hidden = self._hidden(size)
        return tuple(sorted({*hidden, *self.measured})) if self.measurement_noise else hidden

    def told(self, size: int) -> tuple[int, ...]:
        """Which entries an agent on estimates would see if these were right and there were no noise."""
        return (*self.measured, *self._hidden(size))

    def signals(self, size: int) -> dict[str, Any]:
        """The signals to record, as :class:`training.rollouts.playing.Recorder` takes them."""
        return {"measured": [str(i) for i in self.measured], "hidden": self.estimated(size)}

    def _hidden(self, size: int) -> tuple[int, ...]:
        return tuple(i for i in range(size) if i not in self.measured) if self.hidden is None else self.hidden


def _pairs(env_id: str, values: Any, measured: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    """Angles as pairs of entries, or ValueError."""
    given = values.tolist() if isinstance(values, np.ndarray) else values
    if not (
        isinstance(given, list | tuple) and all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in given)
    ):
        raise ValueError(f"angles must be pairs of entries, cosine and sine, such as 0,1; got {shown(values)}")
    found = tuple((integer("a cosine", cosine, 0), integer("a sine", sine, 0)) for cosine, sine in given)
    named = [entry for pair in found for entry in pair]
    if len(set(named)) < len(named) or not set(named) <= set(measured):
        raise ValueError(
            f"angles must name entries of {env_id} that are measured, {shown(measured)}, each once, got {shown(values)}"
        )
    return found


class MeasurementNoise(gym.Wrapper[np.ndarray, Any, np.ndarray, Any], RecordConstructorArgs):
    """Adds independent Gaussian noise to some entries of an observation.

    Its generator is its own, seeded as the environment is: with noise and without, the same seed begins the same
    episodes. ``info`` holds what was before the noise: ``clean``, the whole observation, and ``clean_y``, the entries
    on which noise lies.
    """

    def __init__(self, env: gym.Env[np.ndarray, Any], entries: Sequence[int], standard_deviation: float) -> None:
        RecordConstructorArgs.__init__(self, entries=list(entries), standard_deviation=standard_deviation)
        gym.Wrapper.__init__(self, env)
        self._entries, self._size = list(entries), standard_deviation
        self._rng = np.random.default_rng()
        low, high = env.observation_space.low.copy(), env.observation_space.high.copy()  # type: ignore[attr-defined]
        low[self._entries], high[self._entries] = -np.inf, np.inf
        self.observation_space = spaces.Box(low, high, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environment, and with a seed the noise."""
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])
        observation, info = self.env.reset(seed=seed, options=options)
        return self._noisy(observation, info), info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the environment, and add noise."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._noisy(observation, info), float(reward), terminated, truncated, info

    def _noisy(self, observation: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        noisy = np.array(observation, dtype=np.float32)
        info[CLEAN], info[CLEAN_Y] = noisy.astype(float), noisy[self._entries].astype(float)
        noisy[self._entries] += self._size * self._rng.standard_normal(len(self._entries))
        return noisy


# Positions without velocities, as rl-zoo3's tasks hide them, and what an observer estimates where it is not all the
# rest: of the double pendulum not the forces of its constraints.
HIDDEN_VELOCITIES: dict[str, HiddenTask] = {
    task.env_id: task
    for task in (
        HiddenTask("Pendulum-v1", (0, 1)),
        HiddenTask("CartPole-v1", (0, 2)),
        HiddenTask("MountainCarContinuous-v0", (0,)),
        HiddenTask("LunarLander-v3", (0, 1, 4, 6, 7)),
        HiddenTask("InvertedPendulum-v5", (0, 1)),
        HiddenTask("InvertedDoublePendulum-v5", (0, 1, 2, 3, 4), hidden=(5, 6, 7)),
        HiddenTask("Reacher-v5", (0, 1, 2, 3, 4, 5, 8, 9)),
        HiddenTask("Hopper-v5", (0, 1, 2, 3, 4)),
        HiddenTask("HalfCheetah-v5", (0, 1, 2, 3, 4, 5, 6, 7)),
    )
}
