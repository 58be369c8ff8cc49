"""The reward in the training of agents for systems."""

from typing import Any

import numpy as np

from kkl_gym.wrappers.vector import VectorEnv, VectorWrapper
from training.agents.tasks import Task

MAX_COST = 10.0  # about three scales from the target in every state; larger costs would dominate the training


def paid(task: Task, total: Any, age: Any, terminated: Any) -> Any:
    """Return minus the cost c, at most ``MAX_COST``, from the mean reward 1/(1 + 4c) over an action's samples."""
    samples = np.where(terminated, (age - 1) % task.repeat + 1, task.repeat)
    remaining = np.where(terminated, task.steps - np.ceil(age / task.repeat), 0.0)
    cost = np.minimum((samples / np.maximum(total, 1e-6) - 1.0) / 4.0, MAX_COST)
    return -cost * (1.0 + remaining)


class Cost(VectorWrapper):
    """Rewards with minus the cost, see :func:`paid`, if a system does not define its own reward.

    Far from the target the environment's reward is flat, while c still has a slope for an agent to follow. Escaping
    never pays off.
    """

    def __init__(self, env: VectorEnv, task: Task) -> None:
        super().__init__(env)
        self._task = task

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step the environments, and replace the rewards. Shapes: ``actions`` (n, nu)."""
        obs, total, terminated, truncated, info = self.env.step(actions)
        age = info["final_info"]["sample"] if terminated.any() else info["sample"]
        return obs, paid(self._task, total, age, terminated), terminated, truncated, info
