"""Gymnasium's vector environments as vector environments of stable-baselines3."""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn


class SB3VecEnv(VecEnv):
    """A stable-baselines3 ``VecEnv`` around any Gymnasium ``VectorEnv`` with ``autoreset_mode`` SAME_STEP.

    ``VecMonitor``, ``VecNormalize`` and ``VecFrameStack`` may wrap it. A row is one environment of the vector. When a
    row's episode ends, its info has ``terminal_observation`` (the last one before the reset), ``TimeLimit.truncated``
    and all that the environment reported for the last step. At other steps the info holds only ``info_keys``, because
    filling a full dictionary for each row takes longer than a step of a batched simulation.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        A vector environment with ``autoreset_mode`` SAME_STEP.
    info_keys : sequence of str
        Keys of ``info`` to report at every step.

    Raises
    ------
    ValueError
        If the environment has another autoreset mode or an empty action space, or if the options of the rows differ.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], info_keys: Sequence[str] = ()) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"stable-baselines3 needs environments that reset in the same step, got one with {mode}: use "
                'autoreset_mode="SameStep" (vector_kwargs={"autoreset_mode": "SameStep"} for Sync and Async vectors)'
            )
        if 0 in (env.single_action_space.shape or ()):
            raise ValueError("the action space is empty: an agent needs a system with inputs")
        self.env = env
        self._info_keys = tuple(info_keys)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Reset all rows with the seeds and options that were set for this reset, and return the observations."""
        seeds: Any = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        options = self._options
        self._reset_seeds()
        self._reset_options()
        if any(repr(other) != repr(options[0]) for other in options):
            raise ValueError("a vector environment needs the same options for all rows: set one dictionary")
        obs, info = self.env.reset(seed=seeds, options=dict(options[0]) or None)
        self.reset_infos = [_row(info, row, self._info_keys) for row in range(self.num_envs)]
        return deepcopy(obs)

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows; a row whose episode ends returns the first observation of its next episode."""
        obs, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        infos = [_row(info, row, self._info_keys) for row in range(self.num_envs)]
        # Where an episode has ended, ``info`` describes the new episode, and ``final_info`` the end of the old one.
        for row in np.flatnonzero(done).tolist():
            self.reset_infos[row] = infos[row]
            infos[row] = _row(info, row, _keys(info)) | _row(info["final_info"], row, _keys(info["final_info"]))
            infos[row]["terminal_observation"] = info["final_obs"][row]
            infos[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
        # Some environments write the next observation into the same array.
        return deepcopy(obs), np.asarray(reward, dtype=np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a frame for each row, or None for each if the environment renders none."""
        frames: Any = self.env.render() if self.render_mode == "rgb_array" else None
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute for each row, from the wrapper that stores it, else from the environment inside."""
        rows = list(self._get_indices(indices))
        owner = self._owner(attr_name)
        if owner is not None:
            return [getattr(owner, attr_name)] * len(rows)
        values = self._rows_of("get_attr", attr_name)(attr_name)
        return [values[row] for row in rows]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all rows, in the object where :meth:`get_attr` finds it."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError("attributes can only be set in all rows at once: leave indices out")
        owner = self._owner(attr_name)
        if owner is not None:
            setattr(owner, attr_name, value)
        else:
            self._rows_of("set_attr", attr_name)(attr_name, [value] * self.num_envs)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **options: Any) -> list[Any]:
        """Call a method of each row's environment, and return the results; the vector must be Sync or Async."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError("methods can only be called in all rows at once: leave indices out")
        return list(self._rows_of("call", method_name)(method_name, *args, **options))

    def _owner(self, name: str) -> Any:
        """Return the wrapper that stores an attribute, else the vector environment, or None for Sync and Async."""
        env: Any = self.env
        while hasattr(env, "env"):
            if name in vars(env):
                return env
            env = env.env
        return None if hasattr(env, "get_attr") else env

    def _rows_of(self, how: str, name: str) -> Any:
        if not hasattr(self.env.unwrapped, how):
            raise AttributeError(f"{self.env} has no {name!r}, and its rows are not separate environments")
        return getattr(self.env.unwrapped, how)

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return for each row whether a wrapper of this class surrounds the vector environment."""
        env: Any = self.env
        while not (wrapped := isinstance(env, wrapper_class)) and hasattr(env, "env"):
            env = env.env
        return [wrapped for _ in self._get_indices(indices)]


def _row(info: dict[str, Any], row: int, keys: Sequence[str]) -> dict[str, Any]:
    """Return the entries of ``info`` for a row; a mask ``_key``, if there is one, marks the rows that have ``key``."""
    out = {}
    for key in keys:
        if key in info and (f"_{key}" not in info or info[f"_{key}"][row]):
            value = info[key]
            out[key] = _row(value, row, _keys(value)) if isinstance(value, dict) else value[row]
    return out


def _keys(info: dict[str, Any]) -> list[str]:
    return [key for key in info if not key.startswith("_") and key not in ("final_obs", "final_info")]
