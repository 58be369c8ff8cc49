"""What agents are paid in training."""

from typing import Any

import numpy as np

from kkl_gym.wrappers.vector import VectorEnv, VectorWrapper
from training.systems import ControlTask

WORST = 10.0  # of the cost, three scales off in every state; beyond it, networks would learn little else


class Cost(VectorWrapper):
    """Rewards minus the cost c, at most ``WORST``, from the reward 1/(1 + 4c) averaged over an action's samples.

    The environment's reward is flat far from the target, where c still tells an agent which way to go. A state that
    escapes is taken to stay where it left for the rest of the episode, so that escaping never pays.

    Parameters
    ----------
    env : VectorEnv
        Whose rewards are replaced; it resets in the same step.
    task : ControlTask
        What made it.
    """

    def __init__(self, env: VectorEnv, task: ControlTask) -> None:
        super().__init__(env)
        self._task = task

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step, and replace the rewards.

        Parameters
        ----------
        actions : ndarray, shape (n, nu)
            As the environment takes them.

        Returns
        -------
        obs, reward, terminated, truncated, info
            What the environment returns, but for the rewards.
        """
        obs, total, terminated, truncated, info = self.env.step(actions)
        samples = np.full(self.num_envs, self._task.repeat)
        remaining = np.zeros(self.num_envs)
        if terminated.any():
            age = info["final_info"]["sample"]
            samples = np.where(terminated, (age - 1) % self._task.repeat + 1, samples)
            remaining = np.where(terminated, self._task.steps - np.ceil(age / self._task.repeat), 0.0)
        cost = np.minimum((samples / np.maximum(total, 1e-6) - 1.0) / 4.0, WORST)
        return obs, -cost * (1.0 + remaining), terminated, truncated, info
