"""The control task of a shipped system as a wrapper of one environment, for what trains on single environments."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from kkl_gym import ActionRepeat, KKLEnv, KKLObservation
from observers.checks import shown
from training.agents.cost import paid
from training.agents.information import observer_of
from training.agents.tasks import deviation, get_task


class OnTask(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Shows an agent what ``kkl-gym agent train SYSTEM`` shows it, and pays it the same.

    The agent sees (x_hat - target) / scale and acts once in a period of the task, while the observer sees every sample.
    It is paid minus the cost. Row i of the task's vector environment behaves as this one does with that row's seed.

    Noise, starts and length of the episodes are the environment's: make it with
    ``gym.make(ID, **training.agents.tasks.get_task(SYSTEM).options)``. The files in training/agents/hyperparameters do
    so for rl-zoo3.

    Parameters
    ----------
    env : gymnasium.Env
        A :class:`kkl_gym.KKLEnv` with inputs, bare or under wrappers that leave ``info`` alone.
    observer : str or path, optional
        As for :class:`kkl_gym.KKLObservation`; by default the map that the system's agents act on.

    Raises
    ------
    ValueError
        As :class:`kkl_gym.KKLObservation`, and if the environment is another, its dt is not the task's, or its system
        has no inputs.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from training.agents import OnTask
    >>> from training.agents.tasks import get_task
    >>> env = OnTask(gym.make("KKLLorenz-v0", **get_task("lorenz").options))
    >>> obs, info = env.reset(seed=0)
    >>> obs, reward, terminated, truncated, info = env.step([0.0])
    >>> obs.shape, reward < 0, info["sample"]
    ((3,), True, array(5))
    """

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], observer: str | None = None) -> None:
        base = env.unwrapped if isinstance(env, gym.Env) else env
        if not isinstance(base, KKLEnv):
            raise ValueError(f"OnTask needs an environment of a system, got {shown(env)}")
        RecordConstructorArgs.__init__(self, observer=observer)
        self._system, self._task = base.system, get_task(base.system)
        if base.dt != self._task.dt:
            raise ValueError(f"the environment has dt = {base.dt} s, the task {self._task.dt} s: make it with that")
        seen = KKLObservation(env, observer or observer_of(base.system))
        gym.Wrapper.__init__(self, ActionRepeat(seen, self._task.repeat))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (base.system.nx,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Parameters
        ----------
        seed : int, optional
            As for the environment.
        options : dict, optional
            As for the environment.

        Returns
        -------
        observation : ndarray of float32, shape (nx,)
            The first estimate, from the target and in scales.
        info : dict
            The environment's.
        """
        _, info = self.env.reset(seed=seed, options=options)
        return self._seen(info), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Act for a period.

        Parameters
        ----------
        action : array_like, shape (nu,)
            As for the environment.

        Returns
        -------
        observation : ndarray of float32, shape (nx,)
            The estimate after the last sample, from the target and in scales.
        reward : float
            Minus the cost.
        terminated, truncated : bool
            The environment's.
        info : dict
            The environment's, of the last sample.
        """
        _, total, terminated, truncated, info = self.env.step(action)
        reward = float(paid(self._task, total, info["sample"], terminated))
        return self._seen(info), reward, terminated, truncated, info

    def _seen(self, info: dict[str, Any]) -> np.ndarray:
        return deviation(self._system, info["x_hat"]).astype(np.float32)


__all__ = ["OnTask"]
