"""The reward from which agents learn to control systems."""

from typing import Any

import numpy as np

from kkl_gym.wrappers.vector import VectorEnv, VectorWrapper
from training.agents.tasks import Task

# The cost if each state is about three times its System.scale from the target. Larger costs would dominate training.
MAX_COST = 10.0


def paid(task: Task, total: Any, age: Any, terminated: Any) -> Any:
    """Return an action's reward: minus its cost, which is at most ``MAX_COST``.

    ``total`` is the sum of the environment's rewards over the action's samples; their mean is 1/(1 + 4c) at cost c.
    An action that ends the episode early, after ``age`` samples, also pays its cost for each action that would follow.
    """
    samples = np.where(terminated, (age - 1) % task.repeat + 1, task.repeat)
    remaining = np.where(terminated, task.steps - np.ceil(age / task.repeat), 0.0)
    cost = np.minimum((samples / np.maximum(total, 1e-6) - 1.0) / 4.0, MAX_COST)
    return -cost * (1.0 + remaining)


class Cost(VectorWrapper):
    """Replaces the reward by minus the cost (:func:`paid`), for systems that do not define their own reward.

    Far from the target the reward 1/(1 + 4c) is flat, while the cost c has a gradient until it is limited.
    """

    def __init__(self, env: VectorEnv, task: Task) -> None:
        super().__init__(env)
        self._task = task

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step the environments and replace the rewards. Shapes: ``actions`` (n, nu)."""
        obs, total, terminated, truncated, info = self.env.step(actions)
        age = info["final_info"]["sample"] if terminated.any() else info["sample"]
        return obs, paid(self._task, total, age, terminated), terminated, truncated, info
