"""Who acts in rollouts: random actions, a function, or an agent of stable-baselines3."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym

from kkl_gym.loading import load_function
from observers.checks import shown

Policy = Callable[[Any], Any]  # from an observation to an action
RANDOM = "random"
WANDERING = "wandering"
LONGEST_HELD = 30  # steps, of the mean for which an action is held


def policy_of(policy: str | Policy, env: gym.Env[Any, Any]) -> Policy:
    """Find who acts."""
    if callable(policy):
        return policy
    if policy == RANDOM:
        space = env.action_space
        return lambda observation: space.sample()
    if policy == WANDERING:
        return _Wandering(env.action_space)
    if not isinstance(policy, str) or ":" not in policy:
        raise ValueError(
            "a policy is random, wandering, script.py:function, module:function or an agent as in ppo:FILE.zip, "
            f"got {shown(policy)}"
        )
    algorithm, _, file = policy.partition(":")
    if file.endswith(".zip"):
        return _agent(algorithm, Path(file), env)
    if Path(f"{file}.zip").is_file():  # stable-baselines3 adds the ending as well
        return _agent(algorithm, Path(f"{file}.zip"), env)
    return load_function(policy)


class _Wandering:
    """Random actions, each held for a random number of steps."""

    def __init__(self, space: gym.Space[Any]) -> None:
        self._space, self._calls, self._left = space, 0, 0

    def __call__(self, observation: Any) -> Any:
        rng = self._space.np_random
        if self._calls % 100 == 0:
            self._mean = LONGEST_HELD ** rng.random()
        self._calls += 1
        if self._left == 0:
            self._action, self._left = self._space.sample(), int(rng.geometric(1 / self._mean))
        self._left -= 1
        return self._action


def _agent(name: str, path: Path, env: gym.Env[Any, Any]) -> Policy:
    import stable_baselines3

    found = getattr(stable_baselines3, name.upper(), None)
    if found is None:
        import sb3_contrib

        found = {cls.lower(): getattr(sb3_contrib, cls) for cls in sb3_contrib.__all__}.get(name.lower())
    if found is None:
        raise ValueError(f"{name!r} is no algorithm of stable-baselines3 or sb3-contrib; name it as in ppo:FILE.zip")
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    agent = found.load(path, device="cpu")
    for what in ("observation_space", "action_space"):
        here, there = getattr(env, what), getattr(agent, what)
        if here != there:
            raise ValueError(
                f"{path} was trained on the {what.replace('_', ' ')} {there}, but the environment has {here}"
            )
    return lambda observation: agent.predict(observation, deterministic=True)[0]
