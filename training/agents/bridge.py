"""Gymnasium's vector environments for stable-baselines3, which has vector environments of its own kind."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn


class SB3VecEnv(VecEnv):
    """A stable-baselines3 ``VecEnv`` over any Gymnasium ``VectorEnv`` that resets in the same step.

    ``VecMonitor``, ``VecNormalize`` and ``VecFrameStack`` go on top. Where an episode ends, the row's info holds
    ``terminal_observation`` (the one before the reset), ``TimeLimit.truncated`` and all that the environment
    reported of the last step. Other steps report ``info_keys`` only, because a dictionary for each row
    and step costs more than a batched simulation.

    Parameters
    ----------
    env : a vector environment with ``autoreset_mode`` SAME_STEP.
    info_keys : what of ``info`` to pass on in every step.

    Raises
    ------
    ValueError : if the environment resets otherwise, or stable-baselines3 sets different options for different rows.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], info_keys: Sequence[str] = ()) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"stable-baselines3 needs environments that reset in the same step, this one has {mode}: make it with "
                'autoreset_mode="SameStep" (vector_kwargs={"autoreset_mode": "SameStep"} for Sync and Async vectors)'
            )
        self.env = env
        self._info_keys = tuple(info_keys)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Reset all rows, with the seeds and options that were set for the next reset."""
        options = self._options[0]
        if any(other != options for other in self._options):
            raise ValueError("a vector environment takes the same options for all rows: set_options(a dictionary)")
        seeds: Any = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        obs, info = self.env.reset(seed=seeds, options=dict(options) or None)
        self.reset_infos = [self._row(info, row, self._info_keys) for row in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return obs  # type: ignore[no-any-return]

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows."""
        obs, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        infos = [self._row(info, row, self._info_keys) for row in range(self.num_envs)]
        for row in np.flatnonzero(done).tolist():
            final = info.get("final_info", {})
            infos[row] = self._row(final, row, [key for key in final if not key.startswith("_")])
            infos[row]["terminal_observation"] = info["final_obs"][row]
            infos[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
        return obs, np.asarray(reward, dtype=np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Frames of all rows, None where the environment renders nothing."""
        frames: Any = self.env.render() if self.render_mode == "rgb_array" else None
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each row: its own in Sync and Async vectors, else the vector environment's."""
        rows = list(self._get_indices(indices))
        base: Any = self.env.unwrapped
        if hasattr(base, "get_attr"):
            values = base.get_attr(attr_name)
            return [values[row] for row in rows]
        env: Any = self.env
        while not hasattr(env, attr_name) and hasattr(env, "env"):
            env = env.env
        return [getattr(env, attr_name)] * len(rows)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment; raises ValueError for some rows only."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError("attributes of a vector environment are set for all rows at once")
        setattr(self.env.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **options: Any) -> list[Any]:
        """Call a method of each row, in Sync and Async vectors; raises AttributeError in others, which have no rows."""
        base: Any = self.env.unwrapped
        if not hasattr(base, "call"):
            raise AttributeError(f"the rows of {base} are no environments with a method {method_name!r}")
        results = base.call(method_name, *args, **options)
        return [results[row] for row in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Whether a wrapper of this class is around the vector environment."""
        env: Any = self.env
        while not (found := isinstance(env, wrapper_class)) and hasattr(env, "env"):
            env = env.env
        return [found for _ in self._get_indices(indices)]

    @staticmethod
    def _row(info: dict[str, Any], row: int, keys: Sequence[str]) -> dict[str, Any]:
        """What ``info`` reports of a row; environments need not say for which rows they report a key."""
        return {key: info[key][row] for key in keys if key in info and (f"_{key}" not in info or info[f"_{key}"][row])}


__all__ = ["SB3VecEnv"]
