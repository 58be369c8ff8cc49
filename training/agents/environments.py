"""The vector environments of tasks: one batched simulation for a system, else a ``SyncVectorEnv``."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from kkl_gym import KKLVectorEnv, VectorActionRepeat
from kkl_gym.wrappers.vector import VectorEnv
from observers.checks import shown
from training.agents.tasks import Task
from training.rollouts.playing import make

CLEAN, CLEAN_Y = "clean", "clean_y"  # keys of info: the observation without added noise, and its measured entries


def vector(
    task: Task,
    num_envs: int,
    wrap: Callable[[VectorEnv], VectorEnv] = lambda env: env,
    *,
    each: Callable[[], gym.Env[Any, Any]] | None = None,
) -> VectorEnv:
    """Make a task's environments, with autoreset mode SAME_STEP.

    ``wrap`` wraps them inside the action repeat, if any. Without a system, each call of ``each`` makes one environment.
    """
    if task.system is None:
        side_by_side = SyncVectorEnv([each or partial(single, task)] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
        return wrap(side_by_side)
    options = {key: value for key, value in task.env_kwargs.items() if key != "system"}
    options |= {"measurement_noise": task.measurement_noise, "autoreset_mode": AutoresetMode.DISABLED}
    env = wrap(KKLVectorEnv(task.system, num_envs, **options))
    return VectorActionRepeat(env, task.repeat, AutoresetMode.SAME_STEP)


def single(task: Task, *, noisy: bool = True) -> gym.Env[np.ndarray, Any]:
    """Make one environment of a task without a system; observations are flat, and ``noisy`` adds measurement noise."""
    env = make(task.env_id, task.env_kwargs)
    if not (isinstance(env.observation_space, spaces.Box) and len(env.observation_space.shape) == 1):
        env = gym.wrappers.FlattenObservation(env)
    space = env.observation_space
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1 and space.dtype != np.uint8):
        raise ValueError(f"an observation of {task.env_id} is not a vector of numbers: {shown(space)}")
    for entry in (*task.measured, *(task.hidden or ())):
        if entry >= space.shape[0]:
            raise ValueError(f"there is no entry {entry} in {task.env_id}, only entries 0 to {space.shape[0] - 1}")
    if not task.measurement_noise:
        return env
    assert isinstance(task.measurement_noise, float)
    return MeasurementNoise(env, task.measured, task.measurement_noise if noisy else 0.0)


class MeasurementNoise(gym.Wrapper[np.ndarray, Any, np.ndarray, Any], RecordConstructorArgs):
    """Adds independent Gaussian noise to some entries of an observation.

    The noise has its own random generator, so that a seed starts the same episodes with and without noise. ``info``
    gains the noise-free observation, ``clean``, and the noise-free values of the noisy entries, ``clean_y``.
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
        """Reset the environment; a seed also seeds the noise."""
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
