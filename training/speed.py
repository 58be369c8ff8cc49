"""How fast the environments step, as a ratio to a well-known one measured in the same run."""

import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table

import kkl_gym

REFERENCE = "Pendulum-v1"


@dataclass(frozen=True)
class Speed:
    """Time single environments, bare and with an observer, against Gymnasium's Pendulum-v1.

    Actions are drawn beforehand. The environments take turns, several times over, and each ratio is the median of
    those to the reference in the same turn, because a shared machine's speed drifts.
    """

    steps: int = 5000
    """Steps of each environment in a turn."""
    turns: int = 7
    """Number of turns."""

    def run(self, console: Console) -> dict[str, float]:
        """Measure; returns the steps per second of each environment as multiples of the reference's."""
        envs = {REFERENCE: gym.make(REFERENCE)}
        for env_id in kkl_gym.ENV_IDS.values():
            envs[env_id] = gym.make(env_id)
            envs[f"{env_id}, x_hat"] = kkl_gym.KKLObservation(gym.make(env_id))
        actions = {}
        for name, env in envs.items():
            env.action_space.seed(0)
            actions[name] = [env.action_space.sample() for _ in range(self.steps)]
        seconds: dict[str, list[float]] = {name: [] for name in envs}
        for turn in range(self.turns + 1):
            for name, env in envs.items():
                elapsed = timed(env, actions[name])
                if turn:  # the first one warms up
                    seconds[name].append(elapsed)
        reference = np.array(seconds[REFERENCE])
        ratios = {name: float(np.median(reference / np.array(times))) for name, times in seconds.items()}
        table = Table("environment", "µs per step", f"speed relative to {REFERENCE}")
        for name, ratio in ratios.items():
            table.add_row(name, f"{1e6 * np.median(seconds[name]) / self.steps:.1f}", f"{ratio:.2f}")
        console.print(table)
        return ratios


def timed(env: gym.Env, actions: list[np.ndarray]) -> float:
    """Seconds that the actions take, resets of ended episodes included."""
    env.reset(seed=0)
    started = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return time.perf_counter() - started
