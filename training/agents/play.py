"""Play episodes of a control task."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from gymnasium.vector import AutoresetMode

from kkl_gym.wrappers.vector import VectorEnv

Policy = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Episodes:
    """Episodes side by side, (steps + 1, n, signals), at the instants at which the agent acts."""

    x: np.ndarray
    x_hat: np.ndarray | None
    y: np.ndarray
    u: np.ndarray
    escaped: np.ndarray

    def row(self, i: int) -> "Episodes":
        """One of them, as a batch of one."""
        x_hat = None if self.x_hat is None else self.x_hat[:, [i]]
        return Episodes(self.x[:, [i]], x_hat, self.y[:, [i]], self.u[:, [i]], self.escaped[[i]])


def play(
    env: VectorEnv, policy: Policy, *, steps: int, seed: int, report: Callable[[int], object] = lambda done: None
) -> Episodes:
    """Play one episode in each row of an environment that does not reset by itself."""
    if env.metadata["autoreset_mode"] is not AutoresetMode.DISABLED:
        raise ValueError(
            'play needs an environment made with autoreset_mode="Disabled", or episodes would run together'
        )
    obs, info = env.reset(seed=seed)
    x, x_hat, y, u = [info["x"]], [info.get("x_hat")], [info["y"]], []
    escaped = np.zeros(env.num_envs, dtype=bool)
    for done in range(1, steps + 1):
        obs, _, terminated, _, info = env.step(policy(obs))
        escaped |= terminated
        x.append(info["x"])
        x_hat.append(info.get("x_hat"))
        y.append(info["y"])
        u.append(info["u"])
        report(done)
    estimates = None if x_hat[0] is None else np.array(x_hat)
    return Episodes(np.array(x), estimates, np.array(y), np.array(u), escaped)
