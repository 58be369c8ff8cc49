"""Stacked observations and exponential traces: linear filters that show an agent past observations and actions."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

from kkl_gym.identity import source_of
from kkl_gym.signals import Inputs
from kkl_gym.wrappers.vector import VectorEnv, VectorWrapper


class History(VectorWrapper):
    """Shows the state s of linear filters; action u and next observation y turn s into ``keep`` s + ``take`` [y, u].

    At an episode's start each filter holds the first observation and a zero action; without ``actions``, u is left out.
    Needs autoreset mode SAME_STEP. Shapes: ``keep`` (k, k), ``take`` (k,); observations (n, k * (ny + nu)), float32.
    """

    def __init__(self, env: VectorEnv, keep: np.ndarray, take: np.ndarray, *, actions: bool = True) -> None:
        super().__init__(env)
        self._inputs = Inputs(env.single_action_space, source=source_of(env)) if actions else None
        self._keep, self._take = keep, take[:, None]
        self._nu = 0 if self._inputs is None else len(self._inputs.low)
        width = len(take) * (gym.spaces.flatdim(env.single_observation_space) + self._nu)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environments and the filters."""
        obs, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._state = self._first(obs)
        return self._observation(), info

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step the environments and the filters."""
        u = np.empty((self.num_envs, 0)) if self._inputs is None else self._inputs(actions, (self.num_envs,))
        obs, reward, terminated, truncated, info = self.env.step(actions)
        ended = np.flatnonzero(terminated | truncated)
        y = obs.copy()
        for row in ended:
            y[row] = info["final_obs"][row]
        self._state = self._keep @ self._state + self._take * np.concatenate([y, u], axis=1)[:, None]
        if len(ended):
            last, final = self._observation(), np.full(self.num_envs, None, dtype=object)
            for row in ended:
                final[row] = last[row].copy()
            info["final_obs"] = final
            self._state[ended] = self._first(obs[ended])
        return self._observation(), reward, terminated, truncated, info

    def _first(self, obs: np.ndarray) -> np.ndarray:
        signal = np.concatenate([obs, np.zeros((len(obs), self._nu))], axis=1)
        return np.repeat(signal[:, None], len(self._take), axis=1)

    def _observation(self) -> np.ndarray:
        return self._state.reshape(len(self._state), -1).astype(np.float32)


def stacked(env: VectorEnv, frames: int, *, actions: bool = True) -> History:
    """Show the last ``frames`` observations in order of time and, with ``actions``, the action that led to each."""
    return History(env, np.eye(frames, k=1), np.eye(frames)[-1], actions=actions)


def traces(env: VectorEnv, time_constants: Sequence[float], *, actions: bool = True) -> History:
    """Show the last observation and action, and exponential traces of both; time constants are in steps."""
    decay = np.exp(-1.0 / np.array([*time_constants]))
    return History(env, np.diag([*decay, 0.0]), np.append(1.0 - decay, 1.0), actions=actions)
