"""Playing episodes, and keeping what happened."""

import copy
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from kkl_gym.identity import identity, sampling_interval
from kkl_gym.named import InputReader, Reader, acting, resolved
from observers.checks import integer
from training.records import Episode, Rollouts, Signals
from training.rollouts.policies import Policy


def make(env_id: str, kwargs: Mapping[str, Any] | None = None) -> gym.Env[Any, Any]:
    """Make an environment."""
    try:
        return gym.make(env_id, **(kwargs or {}))
    except (gym.error.Error, ImportError, TypeError, ValueError) as error:
        raise ValueError(f"cannot make {env_id!r}: {error}") from error


def roll_out(
    env: gym.Env[Any, Any],
    policy: Policy,
    *,
    measured: Sequence[str | int],
    hidden: Sequence[str | int],
    episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    name: str = "",
    report: Callable[[float], object] | None = None,
) -> Rollouts:
    """Play episodes and keep observations, actions and what is asked of ``info``."""
    if episodes is None and steps is None:
        raise ValueError("say how much to record: episodes or steps")
    for what, count in (("episodes", episodes), ("steps", steps)):
        if count is not None:
            integer(what, count, 1)
    recorder = Recorder(env, measured=measured, hidden=hidden, name=name)
    env.action_space.seed(integer("seed", seed, 0))
    played = total = 0
    while (episodes is None or played < episodes) and (steps is None or total < steps):
        observation, _ = recorder.reset(seed=None if played else seed)
        over, length = False, 0
        while not over and (steps is None or total + length < steps):
            observation, _, terminated, truncated, _ = recorder.step(policy(observation))
            over, length = terminated or truncated, length + 1
        played, total = played + 1, total + length
        if played == 1:
            recorder.rollouts().records()  # an error now, not after hours
        if report is not None:
            report(played if steps is None else total)
    found = recorder.rollouts()
    found.records()  # an error now where a signal cannot be read
    return found


class Recorder(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps the episodes that are played in an environment: observations, actions and what is asked of ``info``."""

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        measured: Sequence[str | int],
        hidden: Sequence[str | int],
        name: str = "",
        keep: int | None = None,
    ) -> None:
        super().__init__(env)
        source = env.spec.id if env.spec else ""
        self._name, self._identity = name or source, identity(env)
        self._signals = Signals(
            measured=resolved(measured, env.observation_space, role="measured", source=source),
            hidden=resolved(hidden, env.observation_space, role="hidden", source=source),
        )
        if not self._signals.measured:
            raise ValueError("say which entries of the observation are measured, as in measured=[0, 1]")
        chosen = (self._signals.measured, self._signals.hidden)
        readers = [Reader(env.observation_space, names, source=source) for names in chosen]
        InputReader(env.action_space, acting(env.action_space), source=source)  # an error now, not after hours
        self._keys = tuple(dict.fromkeys(key for reader in readers for key in reader.keys))
        self._played, self._steps = deque[Episode](), 0
        self._to_keep = math.inf if keep is None else integer("keep", keep, 1)
        self._begin()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; the episode before counts as far as it got."""
        self._end()
        observation, info = self.env.reset(seed=seed, options=options)
        self._keep(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment; raises RuntimeError before a reset, or after :meth:`rollouts` without one."""
        if not self._observations:
            raise RuntimeError("reset the environment before its first step")
        self._actions.append(copy.deepcopy(action))
        observation, reward, self._terminated, truncated, info = self.env.step(action)
        self._keep(observation, info)
        self._rewards.append(float(reward))
        return observation, float(reward), self._terminated, truncated, info

    def rollouts(self, *, going_on: bool = False) -> Rollouts:
        """Hand out what was played; the episode that is going on counts as far as it got, and is not gone on with."""
        if not going_on:
            self._end()
        under_way = [self._episode()] if self._rewards else []
        return Rollouts(
            self._name,
            self._identity,
            sampling_interval(self.env),
            self.env.observation_space,
            self.env.action_space,
            [*self._played, *under_way],
            self._signals,
        )

    def _begin(self) -> None:
        self._observations, self._actions, self._infos = list[Any](), list[Any](), list[list[Any]]()
        self._rewards, self._terminated = list[float](), False

    def _keep(self, observation: Any, info: Mapping[str, Any]) -> None:
        # Environments and policies may write into the same array at each step.
        self._observations.append(copy.deepcopy(observation))
        self._infos.append([copy.deepcopy(info.get(key)) for key in self._keys])

    def _end(self) -> None:
        if self._rewards:
            self._played.append(self._episode())
            self._steps += len(self._rewards)
            while self._steps - len(self._played[0].rewards) >= self._to_keep:
                self._steps -= len(self._played.popleft().rewards)
        self._begin()

    def _episode(self) -> Episode:
        """The one that is going on, as far as it got."""
        return Episode(
            _stacked(self.env.observation_space, self._observations),
            _stacked(self.env.action_space, self._actions),
            np.array(self._rewards),
            bool(self._terminated),
            {key: _values(list(values), key) for key, values in zip(self._keys, zip(*self._infos))},
        )


def _values(values: list[Any], key: str) -> np.ndarray:
    """What ``info`` held under a key at each step; NaN at the first where a reset says nothing."""
    if all(value is None for value in values):
        raise ValueError(f"info has no {key!r}, at the reset or at a step")
    if values[0] is None and len(values) > 1 and values[1] is not None:
        values = [np.full(np.shape(values[1]), np.nan), *values[1:]]
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"info[{key}] holds no number at each step, or not always as many") from None


def _stacked(space: gym.Space[Any], values: list[Any]) -> Any:
    """Values of a space, one upon the other: arrays, of a Dict or Tuple in its structure."""
    empty: Any = create_empty_array(space, len(values), fn=np.zeros)
    return concatenate(space, values, empty)
