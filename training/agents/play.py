"""Play episodes of a control task."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kkl_gym.vector_wrappers import VectorEnv

Policy = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Episodes:
    """Episodes side by side, at the instants at which the agent acts.

    x : true states, (steps + 1, n, nx); after an escape the last one inside.
    shown : what the agent saw, (steps + 1, n, ...).
    u : inputs, (steps, n, nu).
    escaped : boolean, (n,).
    """

    x: np.ndarray
    shown: np.ndarray
    u: np.ndarray
    escaped: np.ndarray


def play(env: VectorEnv, policy: Policy, steps: int, seed: int) -> Episodes:
    """One episode in each row of an environment that does not reset by itself (``autoreset_mode="Disabled"``).

    policy : observations (n, ...) in, actions (n, nu) out; rows that have ended are played on in place.
    seed : row i starts from seed + i.
    """
    obs, info = env.reset(seed=seed)
    x, shown, u = [info["x"]], [obs], []
    escaped = np.zeros(env.num_envs, dtype=bool)
    for _ in range(steps):
        obs, _, terminated, _, info = env.step(policy(obs))
        escaped |= terminated
        x.append(info["x"])
        shown.append(obs)
        u.append(info["u"])
    return Episodes(np.array(x), np.array(shown), np.array(u), escaped)
