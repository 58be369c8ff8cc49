"""Play episodes of a task."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from kkl_gym.wrappers.vector import VectorEnv

Policy = Callable[[np.ndarray], Any]
SIGNALS = ("x", "x_hat", "y")  # keys of info whose values are recorded at reset and after each step


@dataclass(frozen=True)
class Episodes:
    """A batch of n episodes; after the end of an episode its last signals are repeated, with ``u`` = 0.

    ``escaped`` marks terminated episodes. Shapes: ``returns``, ``lengths``, ``escaped`` (n,); ``x``, ``x_hat``,
    ``y`` (steps + 1, n, signals) and ``u`` (steps, n, nu), each of these four None if ``info`` does not hold it.
    """

    returns: np.ndarray
    lengths: np.ndarray
    escaped: np.ndarray
    x: np.ndarray | None = None
    x_hat: np.ndarray | None = None
    y: np.ndarray | None = None
    u: np.ndarray | None = None

    def signals(self, name: str) -> np.ndarray:
        """Return x, x_hat, y or u; raise ValueError if the episodes do not hold it."""
        if (values := getattr(self, name)) is None:
            raise ValueError(f"these episodes hold no {name}: the environment's info does not show it")
        return np.asarray(values)


def play(
    env: VectorEnv, policy: Policy, *, seed: int, report: Callable[[float], object] = lambda ended: None
) -> Episodes:
    """Play one episode in each row, with seed ``seed`` + i in row i; the autoreset mode must be SAME_STEP."""
    obs, info = env.reset(seed=seed)
    kept = {key: [info[key]] for key in SIGNALS if key in info}
    inputs = list[np.ndarray]()
    n = env.num_envs
    returns, lengths, over, escaped = np.zeros(n), np.zeros(n, dtype=int), np.zeros(n, dtype=bool), np.zeros(n, bool)
    while not over.all():
        obs, reward, terminated, truncated, info = env.step(policy(obs))
        ended, final = terminated | truncated, info.get("final_info", {})
        returns += np.where(over, 0.0, reward)
        lengths += ~over
        escaped |= ended & ~over & terminated
        for key, values in kept.items():
            now = np.where(ended[:, None], final[key], info[key]) if ended.any() else info[key]
            values.append(np.where(over[:, None], values[-1], now))
        if "u" in info:
            now = np.where(ended[:, None], final["u"], info["u"]) if ended.any() else info["u"]
            inputs.append(np.where(over[:, None], 0.0, now))
        over |= ended
        report(int(over.sum()))
    signals = {key: np.array(values) for key, values in kept.items()}
    return Episodes(returns, lengths, escaped, **signals, u=np.array(inputs) if inputs else None)
