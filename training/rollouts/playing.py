"""Rollouts of environments: policies, played episodes, and a wrapper that records them."""

import copy
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from kkl_gym.identity import identity, sampling_interval
from kkl_gym.loading import load_function
from kkl_gym.named import Reader, resolved
from observers.checks import integer, shown
from training.progress import ProgressBars
from training.records import Signals
from training.records.episodes import Episode, Rollouts

Env = gym.Env[Any, Any]
Policy = Callable[[Any], Any]  # from an observation to an action
RANDOM = "random"
WANDERING = "wandering"
LONGEST_HOLD = 30  # longest mean time, in steps, for which a wandering policy holds an action


def make(env_id: str, kwargs: Mapping[str, Any] | None = None) -> Env:
    """Make an environment."""
    try:
        return gym.make(env_id, **(kwargs or {}))
    except (gym.error.Error, ImportError, TypeError, ValueError) as error:
        raise ValueError(f"cannot make {env_id!r}: {error}") from error


def policy_of(policy: str | Policy, env: Env) -> Policy:
    """Make a policy from its name: random, wandering, a function, or an agent of stable-baselines3 (``ppo:A.zip``)."""
    if callable(policy):
        return policy
    if policy == RANDOM:
        return lambda observation: env.action_space.sample()
    if policy == WANDERING:
        held = _wandering(env.action_space)
        return lambda observation: next(held)
    if not isinstance(policy, str) or ":" not in policy:
        raise ValueError(
            "a policy is random, wandering, script.py:function, module:function or an agent as in ppo:FILE.zip, "
            f"got {shown(policy)}"
        )
    algorithm, _, file = policy.partition(":")
    return _agent(algorithm, Path(file), env) if file.endswith(".zip") else load_function(policy)


def _wandering(space: gym.Space[Any]) -> Iterator[Any]:
    """Yield random actions, each held for a random number of steps; every 100 steps, this number's mean changes."""
    left, action = 0, None
    for call in itertools.count():
        if call % 100 == 0:
            mean = LONGEST_HOLD ** space.np_random.random()
        if left == 0:
            action, left = space.sample(), int(space.np_random.geometric(1 / mean))
        left -= 1
        yield action


def _agent(name: str, path: Path, env: Env) -> Policy:
    import sb3_contrib
    import stable_baselines3

    libraries = (sb3_contrib, stable_baselines3)
    algorithms = {each.lower(): getattr(library, each) for library in libraries for each in library.__all__}
    if name.lower() not in algorithms:
        raise ValueError(
            f"{name!r} is not an algorithm of stable-baselines3 or sb3-contrib; name it as in ppo:FILE.zip"
        )
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    agent = algorithms[name.lower()].load(path, env=env, device="cpu")
    return lambda observation: agent.predict(observation, deterministic=True)[0]


def play(
    env_id: str,
    policy_in: Callable[[Env], Policy],
    progress: ProgressBars,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    episodes: int | None = None,
    steps: int | None = None,
    default_steps: int = 100_000,
    **options: Any,
) -> Rollouts:
    """Make an environment and play in it, for ``default_steps`` if neither episodes nor steps are given."""
    steps = default_steps if episodes is None and steps is None else steps
    with make(env_id, env_kwargs) as env:
        policy = policy_in(env)
        with progress.phase(f"playing {env_id}", steps or episodes or 1) as report:
            rollouts = roll_out(env, policy, episodes=episodes, steps=steps, report=report, **options)
    return rollouts


def roll_out(
    env: Env,
    policy: Policy,
    *,
    measured: Sequence[str | int],
    hidden: Sequence[str | int],
    episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    name: str = "",
    report: Callable[[float], object] = lambda done: None,
) -> Rollouts:
    """Play episodes; keep observations, actions, rewards, and the entries of ``info`` that are signals."""
    if episodes is None and steps is None:
        raise ValueError("give the amount to record: episodes or steps")
    most_episodes = math.inf if episodes is None else integer("episodes", episodes, 1)
    most_steps = math.inf if steps is None else integer("steps", steps, 1)
    recorder = Recorder(env, measured=measured, hidden=hidden, name=name)
    env.action_space.seed(integer("seed", seed, 0))
    played = total = 0
    while played < most_episodes and total < most_steps:
        observation, _ = recorder.reset(seed=None if played else seed)
        over = False
        while not over and total < most_steps:
            observation, _, terminated, truncated, _ = recorder.step(policy(observation))
            over, total = terminated or truncated, total + 1
        played += 1
        if played == 1:
            recorder.rollouts().records()  # invalid signals raise here, not after hours of play
        report(played if steps is None else total)
    return recorder.rollouts()


class Recorder(gym.Wrapper[Any, Any, Any, Any]):
    """Records the last episodes in an environment, the fewest that hold ``keep`` steps; by default all episodes."""

    def __init__(
        self,
        env: Env,
        *,
        measured: Sequence[str | int],
        hidden: Sequence[str | int],
        name: str = "",
        keep: int | None = None,
    ) -> None:
        super().__init__(env)
        source = env.spec.id if env.spec else ""
        self._name, self._identity, space = name or source, identity(env), env.observation_space
        chosen = {
            role: resolved(names, space, role=role, source=source)
            for role, names in (("measured", measured), ("hidden", hidden))
        }
        self._signals = Signals("", chosen["measured"], (), chosen["hidden"])
        keys = (key for names in chosen.values() for key in Reader(space, names, source=source).keys)
        self._keys = tuple(dict.fromkeys(keys))
        self._played, self._steps = deque[_Steps](), 0
        self._under_way: _Steps | None = None
        self._to_keep = math.inf if keep is None else integer("keep", keep, 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; an unfinished episode is kept as far as it was played."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._under_way = _Steps([self._copied(observation, info)])
        self._played.append(self._under_way)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment; RuntimeError before the first reset, or without a reset after :meth:`rollouts`."""
        if self._under_way is None:
            raise RuntimeError("reset the environment before the first step of an episode")
        made = copy.deepcopy(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._under_way.seen.append(self._copied(observation, info))
        self._under_way.done.append((made, float(reward)))
        self._under_way.terminated, self._steps = bool(terminated), self._steps + 1
        while self._steps - len(self._played[0].done) >= self._to_keep:
            self._steps -= len(self._played.popleft().done)
        return observation, float(reward), terminated, truncated, info

    def rollouts(self, *, going_on: bool = False) -> Rollouts:
        """Return the episodes, an unfinished one as far as it was played; it can continue only if ``going_on``."""
        self._under_way = self._under_way if going_on else None
        env, episodes = self.env, [self._episode(steps) for steps in self._played if steps.done]
        spaces = env.observation_space, env.action_space
        return Rollouts(self._name, self._identity, sampling_interval(env), *spaces, episodes, self._signals, env.spec)

    def _copied(self, observation: Any, info: Mapping[str, Any]) -> Any:
        """Copy an observation and entries of ``info``, as environments may write into the same array at each step."""
        return copy.deepcopy((observation, [info.get(key) for key in self._keys]))

    def _episode(self, steps: "_Steps") -> Episode:
        (observations, infos), (actions, rewards) = zip(*steps.seen), zip(*steps.done)
        observations, actions = _stacked(self.observation_space, observations), _stacked(self.action_space, actions)
        signals = {key: _numbers(list(values), key) for key, values in zip(self._keys, zip(*infos))}
        return Episode(observations, actions, np.array(rewards), steps.terminated, signals)


@dataclass
class _Steps:
    """An episode: ``seen`` holds pairs of observation and entries of ``info``, ``done`` pairs of action and reward."""

    seen: list[Any]
    done: list[Any] = field(default_factory=list)
    terminated: bool = False


def _numbers(values: list[Any], key: str) -> np.ndarray:
    """Return the entries of ``info`` under a key as an array, with NaN at a reset that lacks the key."""
    if all(value is None for value in values):
        raise ValueError(f"info has no {key!r}, neither at the reset nor at any step")
    if values[0] is None and len(values) > 1 and values[1] is not None:
        values = [np.full(np.shape(values[1]), np.nan), *values[1:]]
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"info[{key}] is not a number at each step, or changes its shape") from None


def _stacked(space: gym.Space[Any], values: Sequence[Any]) -> Any:
    """Stack values of a space into arrays; a Dict or Tuple keeps its structure."""
    empty: Any = create_empty_array(space, len(values), fn=np.zeros)
    return concatenate(space, values, empty)
