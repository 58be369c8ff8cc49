"""The control task of a system as a wrapper, for training on single environments, as in rl-zoo3."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from kkl_gym import ActionRepeat, KKLEnv, KKLObservation
from observers.checks import shown
from training.agents.cost import paid
from training.agents.information import observer_of
from training.agents.tasks import deviation, task_of


class OnTask(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Gives an agent the observations and rewards of ``kkl-gym agent train SYSTEM``.

    The agent sees (x_hat - target) / scale and acts once per period of the task, while the observer sees every sample.
    The reward is minus the cost, or the environment's if the system has its own ``reward`` or ``terminated``. With the
    seed of row i of the task's vector environment, this environment behaves like row i.

    The wrapped environment sets the noise, the starts and the length of episodes: make it with the ``env_kwargs`` of
    ``training.agents.tasks.get_task(SYSTEM)``. In rl-zoo3, hyperparameters/ppo.yml and sac.yml do so if SYSTEM ships.
    """

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], observer: str | None = None) -> None:
        base = env.unwrapped if isinstance(env, gym.Env) else env
        if not isinstance(base, KKLEnv):
            raise ValueError(f"OnTask needs an environment of a system, got {shown(env)}")
        RecordConstructorArgs.__init__(self, observer=observer)
        self._system, self._task = base.system, task_of(base.system)
        if base.dt != (dt := self._task.env_kwargs["dt"]):
            raise ValueError(f"the environment has dt = {base.dt} s, but its task {dt} s: make it with dt={dt}")
        seen = KKLObservation(env, observer or observer_of(base.system))
        gym.Wrapper.__init__(self, ActionRepeat(seen, self._task.repeat))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (base.system.nx,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode. Shapes: returns ``observation`` (nx,)."""
        _, info = self.env.reset(seed=seed, options=options)
        return self._seen(info), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an action for a period of the task. Shapes: ``action`` (nu,); returns ``observation`` (nx,)."""
        _, total, terminated, truncated, info = self.env.step(action)
        pays = total if self._system.states_task else paid(self._task, total, info["sample"], terminated)
        return self._seen(info), float(pays), terminated, truncated, info

    def _seen(self, info: dict[str, Any]) -> np.ndarray:
        return deviation(self._system, info["x_hat"]).astype(np.float32)
