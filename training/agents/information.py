"""Information sets: vector environments with states, outputs, memories or estimates as flat observations."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

from kkl_gym import KKLMemory, KKLVectorMemory, KKLVectorObservation, get_system
from kkl_gym.system import System
from kkl_gym.wrappers.vector import VectorEnv, VectorWrapper, column
from observers import Artifact, shipped
from observers.checks import choice
from observers.factors import standard_deviations
from observers.names import resolve
from training.agents.environments import single, vector
from training.agents.history import stacked, traces
from training.agents.tasks import Task, deviation
from training.trajectories.equations import linearised

Information = Literal["state", "y", "stacked", "traces", "z", "x_hat", "x_hat_std", "recurrent"]
INFORMATION: tuple[Information, ...] = get_args(Information)
ESTIMATED: tuple[Information, ...] = ("x_hat", "x_hat_std")
OBSERVED: tuple[Information, ...] = (*ESTIMATED, "z")  # information that a learned observer can give
MIN_DEVIATION = 1e-6  # lower bound of the standard deviations that agents see; for a system, in units of System.scale

Values = Mapping[str, np.ndarray]
Feature = Callable[[Values], np.ndarray]


class FeatureObservation(VectorWrapper):
    """Shows a function of the observation ``obs`` and of entries of ``info``, as float32."""

    def __init__(self, env: VectorEnv, feature: Feature, width: int, keys: Sequence[str] = ()) -> None:
        super().__init__(env)
        self._feature, self._keys = feature, tuple(keys)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environments."""
        obs, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        return self._features(obs, info), info

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step the environments."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        ended = terminated | truncated
        if ended.any():
            last, final = obs.copy(), np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(ended):
                last[row] = info["final_obs"][row]
            final_info = info.get("final_info", {})
            values = {key: np.where(column(ended, info[key]), final_info[key], info[key]) for key in self._keys}
            features = self._features(last, values)
            for row in np.flatnonzero(ended):
                final[row] = features[row].copy()
            info["final_obs"] = final
        return self._features(obs, info), reward, terminated, truncated, info

    def _features(self, obs: np.ndarray, info: Values) -> np.ndarray:
        return self._feature({"obs": obs} | {key: info[key] for key in self._keys}).astype(np.float32)


def make(task: Task, information: Information, num_envs: int, *, observer: str | None = None) -> VectorEnv:
    """Make environments that show ``information``; x, y and x_hat of a system are scaled deviations from its target."""
    choice("information", information, INFORMATION)
    if observer is not None and information not in OBSERVED:
        raise ValueError(f"an agent that sees {information!r} has no use for the observer {observer!r}")
    if information in (ESTIMATED if task.system is None else OBSERVED) and observer is None:
        raise ValueError(f"an agent that sees {information!r} needs an observer: name it (--observer FILE)")
    if observer is not None:
        return estimates(task, information, num_envs, observer)
    if information == "state" and task.system is None:
        return vector(task.without_noise, num_envs)
    env = vector(task, num_envs)
    if information == "z":
        return KKLVectorMemory(env, **_memory(task))
    if task.system is None:
        entries = list(task.measured)
        env = FeatureObservation(env, lambda at: at["obs"][:, entries], len(entries))
    else:
        system = get_system(task.system)
        if information == "state":
            return FeatureObservation(env, lambda at: deviation(system, at["x"]), system.nx, ["x"])
        env = FeatureObservation(env, output_deviation(system), system.ny, ["y"])
    if information == "stacked":
        return stacked(env, task.frames, actions=task.past_actions)
    if information == "traces":
        return traces(env, task.time_constants, actions=task.past_actions)
    if information == "recurrent":
        return stacked(env, 1)
    return env


def weighted(task: Task, steps: int, *, seed: int) -> Task:
    """Return the task with weights of the memory z, fitted so that z predicts later outputs under random actions."""
    with closing(single(task)) as env:
        return replace(task, weights=KKLMemory(env, **_memory(task)).learn_weights(steps, seed=seed))


def _memory(task: Task) -> dict[str, Any]:
    """Return the arguments of a memory of the task's measured entries."""
    arguments = {name: getattr(task, name) for name in ("measured", "angles", "time_constants", "weights")}
    return arguments if task.past_actions else arguments | {"input_time_constants": ()}


def estimates(task: Task, information: Information, num_envs: int, observer: str) -> VectorEnv:
    """Show x_hat of an observer, x_hat with standard deviations, or z, as ``information`` names it."""
    artifact = Artifact.read(resolve(observer))
    options: dict[str, Any] = {
        "observer": observer,
        "estimate": "z" if information == "z" else "x",
        "uncertainty": information == "x_hat_std",
        "measurement_noise": task.measurement_noise if task.system is None else None,
    }
    env = vector(task, num_envs, partial(KKLVectorObservation, **options))
    system = None if task.system is None else get_system(task.system)
    if information == "z":
        return _modes(env, artifact, system)
    # Without a system, observations are [y, x_hat]; under noise, agents see only x_hat, which then estimates y too.
    first = len(task.measured) if task.measurement_noise else 0
    last = len(task.measured) + artifact.nx
    if system is not None and artifact.nx > system.nx:
        raise ValueError(f"the observer {observer} estimates a bias, which agents do not see: take one without a bias")
    scale = 1.0 if system is None else np.array(system.scale)
    width = artifact.nx if system is not None else last - first

    def feature(at: Values) -> np.ndarray:
        x_hat = at["obs"][:, first:last] if system is None else deviation(system, at["x_hat"])
        if information == "x_hat":
            return x_hat
        # Agents see logarithms, because standard deviations change by orders of magnitude within an episode.
        sizes = np.log10(np.maximum(standard_deviations(at["x_cov"]) / scale, MIN_DEVIATION))
        return np.concatenate([x_hat, sizes], axis=1)

    if information == "x_hat":
        return FeatureObservation(env, feature, width, ["x_hat"])
    return FeatureObservation(env, feature, width + artifact.nx, ["x_hat", "x_cov"])


def observer_of(system: System) -> str:
    """Return the name of a system's shipped observer."""
    if system.name not in shipped():
        raise ValueError(f"no observer ships for {system.name!r}: pass a .safetensors file (--observer FILE)")
    return system.name


def output_deviation(system: System) -> Feature:
    """Return the feature (y - h(target)) / size, where size is the first-order effect of the states' scales on y."""
    _, _, C = linearised(system, system.target)
    y, size = np.array(system.h(system.target)), np.abs(C) @ np.array(system.scale)
    # An output whose gradient vanishes at the target keeps its unit.
    size = np.where(size > 0, size, 1.0)
    return lambda at: (at["y"] - y) / size


def _modes(env: VectorEnv, artifact: Artifact, system: System | None) -> VectorEnv:
    """Show z as T_inv takes it, minus z at a system's target; without a system, z and y. Add age if T_inv takes it."""
    inverse, linear, inside = artifact.inverse, artifact.filter, env
    while not isinstance(inside, KKLVectorObservation):
        inside = inside.env  # type: ignore[attr-defined]
    matrix = (inverse.gain(inside.observer.measurement_noise)[:, None] * inverse.whiten).T
    rest = 0.0 if system is None else linear.start(np.array(system.h(system.target), dtype=float))
    aged = inverse.features[-1] == "age"

    def feature(at: Values) -> np.ndarray:
        parts = [at["y"]] if system is None else []
        parts.append((at["z"] - rest) @ matrix)
        if aged:
            parts.append(inverse.age_feature(at["sample"] * linear.dt)[:, None])
        return np.concatenate(parts, axis=1)

    width = matrix.shape[1] + aged + (artifact.ny if system is None else 0)
    return FeatureObservation(env, feature, width, ["z", "sample", "y"])
