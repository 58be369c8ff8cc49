"""What an agent is shown of an environment of which a part is hidden."""

import math
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import TransformObservation

from kkl_gym import KKLMemory, KKLObservation
from kkl_gym.identity import source_of
from kkl_gym.signals import Inputs
from kkl_gym.turning import turned
from training.agents.any_environment.task import HiddenTask

Shown = Literal["state", "x_hat", "z", "stacked", "recurrent", "y"]
SHOWN: tuple[Shown, ...] = get_args(Shown)


def show(task: HiddenTask, information: Shown, observer: str | None = None) -> gym.Env[np.ndarray, Any]:
    """Make a task's environment in which an agent sees what ``information`` says."""
    if information not in SHOWN:
        raise ValueError(f"an agent is shown one of {', '.join(SHOWN)}, got {information!r}")
    if information == "state":
        return task.without_noise.make()
    if information == "x_hat" and observer is None:
        raise ValueError("an agent that is shown x_hat needs an observer")
    env = task.make()
    if information == "x_hat":
        env = KKLObservation(env, observer, measurement_noise=task.measurement_noise)
        shown: Any = env.observation_space
        return part_of(env, range(len(task.measured), shown.shape[0])) if task.measurement_noise else env
    if information == "z":
        without = {} if task.past_actions else {"input_time_constants": ()}
        return KKLMemory(env, task.measured, angles=task.angles, time_constants=task.time_constants, **without)
    env = part_of(env, task.measured)
    if information == "y":
        return env
    if information == "recurrent":
        return Stacked(env, 1)
    at = task.measured.index
    angles = [(at(cosine), at(sine)) for cosine, sine in task.angles]
    return Stacked(env, task.frames, angles, actions=task.past_actions)


def part_of(env: gym.Env[np.ndarray, Any], entries: Sequence[int]) -> gym.Env[np.ndarray, Any]:
    """Show some entries of an observation alone."""
    space: Any = env.observation_space
    chosen = list(entries)
    part = gym.spaces.Box(space.low[chosen], space.high[chosen], dtype=np.float32)
    return TransformObservation(env, partial(_taken, chosen), part)


def _taken(entries: list[int], observation: np.ndarray) -> np.ndarray:
    return observation[entries].astype(np.float32)


class Stacked(gym.Wrapper[np.ndarray, Any, np.ndarray, Any], RecordConstructorArgs):
    """Shows the last observations, the latest last, and with each the action before it.

    Before an episode's first step there were its first observation and no action. Of an angle earlier observations
    show how far it has turned since, in rad, as :func:`kkl_gym.turning.turned` finds it.
    """

    def __init__(
        self, env: gym.Env[np.ndarray, Any], count: int, angles: Sequence[tuple[int, int]] = (), *, actions: bool = True
    ) -> None:
        RecordConstructorArgs.__init__(self, count=count, angles=angles, actions=actions)
        gym.Wrapper.__init__(self, env)
        self._inputs = Inputs(env.action_space, source=source_of(env)) if actions else None
        self._cosines, self._sines = ([angle[side] for angle in angles] for side in (0, 1))
        self._rows: deque[np.ndarray] = deque(maxlen=count)
        self._turned: deque[np.ndarray] = deque(maxlen=count)  # angles in rad
        of: Any = env.observation_space
        low, high = of.low, of.high
        if self._inputs is not None:  # 0 before the first step
            low = np.append(low, np.minimum(self._inputs.low, 0.0))
            high = np.append(high, np.maximum(self._inputs.high, 0.0))
        self._width = len(low)
        self._straight = [i for i in range(len(low)) if i not in {*self._cosines, *self._sines}]
        furthest = np.full(len(angles), math.pi * (count - 1))
        low, high = (
            np.concatenate([*[np.append(side[self._straight], angles_to)] * (count - 1), side]).astype(np.float32)
            for side, angles_to in ((low, -furthest), (high, furthest))
        )
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environment, and forget what was before."""
        observation, info = self.env.reset(seed=seed, options=options)
        first, count = np.append(observation, np.zeros(self._width - len(observation))), self._rows.maxlen or 1
        self._rows.extend([first] * count)
        if self._sines:
            self._turned.extend([self._angles(first, 0.0)] * count)
        return self._shown(), info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        row = np.append(observation, () if self._inputs is None else self._inputs(action))
        self._rows.append(row)
        if self._sines:
            self._turned.append(self._angles(row, self._turned[-1]))
        return self._shown(), float(reward), terminated, truncated, info

    def _angles(self, row: np.ndarray, before: np.ndarray | float) -> np.ndarray:
        return turned(row[self._cosines], row[self._sines], before)

    def _shown(self) -> np.ndarray:
        if not self._sines:
            return np.concatenate(self._rows, dtype=np.float32)
        *earlier, last = self._rows
        parts = [
            part
            for row, angles in zip(earlier, self._turned)
            for part in (row[self._straight], self._turned[-1] - angles)
        ]
        return np.concatenate([*parts, last], dtype=np.float32)


__all__ = ["SHOWN", "Shown", "Stacked", "part_of", "show"]
