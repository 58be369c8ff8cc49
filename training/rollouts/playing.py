"""Playing episodes, and keeping what happened."""

import copy
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
    """Make an environment.

    Parameters
    ----------
    env_id : str
        As ``gym.make`` takes it.
    kwargs : mapping of str to object, optional
        Its arguments.

    Returns
    -------
    gymnasium.Env
        The environment.

    Raises
    ------
    ValueError
        If there is none of that name, something that it needs is missing, or it does not take the arguments.
    """
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
    """Play episodes and keep observations, actions and what is asked of ``info``.

    Parameters
    ----------
    env : gymnasium.Env
        The environment, made by ``gym.make``.
    policy : callable
        From an observation to an action.
    measured, hidden : sequence of str or int
        Signals, as :func:`kkl_gym.named.resolved` takes them.
    episodes, steps : int, optional
        Where to stop, at whichever comes first; one of them is needed. An episode that ``steps`` ends counts as far as
        it got.
    seed : int
        Of the environment and of random actions.
    name : str
        Of the rollouts.
    report : callable, optional
        Told how many episodes there are, or steps if ``steps`` is given.

    Returns
    -------
    Rollouts
        What happened.

    Raises
    ------
    ValueError
        If a number or a signal makes no sense, or observations or actions are of a kind that is not recorded.
    """
    if episodes is None and steps is None:
        raise ValueError("say how much to record: episodes or steps")
    for what, count in (("episodes", episodes), ("steps", steps)):
        if count is not None:
            integer(what, count, 1)
    env_identity, source = identity(env), env.spec.id if env.spec else ""
    signals = Signals(
        measured=resolved(measured, env.observation_space, role="measured", source=source),
        hidden=resolved(hidden, env.observation_space, role="hidden", source=source),
    )
    if not signals.measured:
        raise ValueError("say which entries of the observation are measured, as in measured=[0, 1]")
    readers = [Reader(env.observation_space, names, source=source) for names in (signals.measured, signals.hidden)]
    InputReader(env.action_space, acting(env.action_space), source=source)  # an error now, not after hours
    keys = tuple(dict.fromkeys(key for reader in readers for key in reader.keys))
    env.action_space.seed(integer("seed", seed, 0))
    played, total = list[Episode](), 0
    found = Rollouts(
        name or source, env_identity, sampling_interval(env), env.observation_space, env.action_space, played, signals
    )
    while (episodes is None or len(played) < episodes) and (steps is None or total < steps):
        left = None if steps is None else steps - total
        played.append(_episode(env, policy, keys, seed=None if played else seed, most=left))
        total += len(played[-1].rewards)
        if len(played) == 1:
            found.records()  # an error now, not after hours
        if report is not None:
            report(len(played) if steps is None else total)
    found.records()  # an error now where a signal cannot be read
    return found


def _episode(
    env: gym.Env[Any, Any], policy: Policy, keys: Sequence[str], *, seed: int | None, most: int | None
) -> Episode:
    observation, info = env.reset(seed=seed)
    observations, actions, infos = list[Any](), list[Any](), list[list[Any]]()
    rewards = list[float]()

    def keep(to: list[Any], value: Any) -> None:
        to.append(copy.deepcopy(value))  # environments and policies may write into the same array at each step

    keep(observations, observation)
    keep(infos, [info.get(key) for key in keys])
    terminated = truncated = False
    while not (terminated or truncated or len(rewards) == most):
        action = policy(observation)
        keep(actions, action)
        observation, reward, terminated, truncated, info = env.step(action)
        keep(observations, observation)
        rewards.append(float(reward))
        keep(infos, [info.get(key) for key in keys])
    asked = {key: _values(list(values), key) for key, values in zip(keys, zip(*infos))}
    return Episode(
        _stacked(env.observation_space, observations),
        _stacked(env.action_space, actions),
        np.array(rewards),
        bool(terminated),
        asked,
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
