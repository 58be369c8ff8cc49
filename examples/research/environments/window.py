"""Estimates by a network on stacked observations: what an observer's filter is worth is the difference to them."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from observers import MLP, storage
from observers.checks import shown
from training.agents.any_environment.information import Stacked, part_of
from training.agents.any_environment.task import HiddenTask
from training.rollouts.playing import Recorder

FORMAT = 1
KEY = "kkl-gym-window"


@dataclass(frozen=True)
class WindowEstimator:
    """A network from the last outputs, each with the input before it, to hidden signals.

    Shapes: ``mean``, ``scale`` (inputs,).
    """

    network: MLP
    mean: np.ndarray
    scale: np.ndarray
    task: Mapping[str, Any]

    def __post_init__(self) -> None:
        for name, values in (("mean", self.mean), ("scale", self.scale)):
            if values.shape != (self.network.inputs,) or not np.isfinite(values).all():
                raise ValueError(f"{name} must be {self.network.inputs} finite numbers, got {shown(values)}")
        if not (self.scale > 0).all():
            raise ValueError(f"scale must be positive, got {shown(self.scale)}")

    @staticmethod
    def made_for(task: HiddenTask) -> dict[str, Any]:
        """What of a task must be the same where an estimator is used."""
        described = {name: getattr(task, name) for name in ("env_id", "env_kwargs", "measured", "hidden", "frames")}
        found: dict[str, Any] = json.loads(json.dumps({**described, "noisy": task.measurement_noise > 0}))
        return found

    def __call__(self, stack: np.ndarray) -> np.ndarray:
        """Estimate.

        Shapes: ``stack`` (..., inputs); returns (..., outputs).
        """
        return self.network((stack - self.mean) / self.scale)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to one safetensors file, whole or not at all."""
        tensors: dict[str, np.ndarray] = {"mean": self.mean, "scale": self.scale}
        storage.put_mlp(tensors, "", self.network)
        described = {"format": FORMAT, "activation": self.network.activation, "task": dict(self.task)}
        storage.save(path, tensors, key=KEY, described=described)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "WindowEstimator":
        """Read what :meth:`save` wrote."""
        tensors, described = storage.read(path, key=KEY, error=ValueError, what="an estimator on stacked observations")
        with storage.explained(path, ValueError):
            if described["format"] != FORMAT:
                raise ValueError(f"it has another format than {FORMAT}, which this version of kkl-gym reads")
            network = storage.get_mlp(tensors, "", described["activation"])
            return cls(network, tensors["mean"], tensors["scale"], dict(described["task"]))


class WindowObservation(gym.ObservationWrapper[np.ndarray, Any, np.ndarray], RecordConstructorArgs):
    """Shows y and what an estimator says of stacked observations, in their place; under noise the estimates alone."""

    def __init__(
        self, env: gym.Env[np.ndarray, Any], task: HiddenTask, estimator: WindowEstimator, space: gym.spaces.Box
    ) -> None:
        RecordConstructorArgs.__init__(self, task=task, estimator=estimator, space=space)
        gym.ObservationWrapper.__init__(self, env)
        self.observation_space, self._low, self._high = space, space.low, space.high
        stacked = gym.spaces.flatdim(env.observation_space)
        outputs = 0 if task.measurement_noise else len(task.measured)  # shown as they are
        latest = stacked - stacked // task.frames
        self._outputs = slice(latest, latest + outputs)
        self._made_for = WindowEstimator.made_for(task)
        self._widths = stacked, gym.spaces.flatdim(space) - outputs
        self.replace_estimator(estimator)

    def replace_estimator(self, estimator: WindowEstimator) -> None:
        """Go on with another estimator for the same task; raises ValueError if it was made for another one."""
        if dict(estimator.task) != self._made_for:
            here, there = self._made_for, estimator.task
            other = [
                f"{name} = {there.get(name)!r}, not {here[name]!r}" for name in here if there.get(name) != here[name]
            ]
            raise ValueError(f"the estimator was made for another task: {'; '.join(other) or shown(there)}")
        network = estimator.network
        if (network.inputs, network.outputs) != self._widths:
            raise ValueError(
                f"the estimator makes {network.outputs} numbers of {network.inputs}, and {self._widths[1]} of "
                f"{self._widths[0]} are needed"
            )
        self._estimator = estimator

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """What is shown of a stack."""
        found = np.concatenate([observation[self._outputs], self._estimator(observation)])
        return np.clip(found, self._low, self._high, dtype=np.float32)


def show_window(task: HiddenTask, path: str | os.PathLike[str], *, keep: int | None = None) -> gym.Env[np.ndarray, Any]:
    """A task's environment that shows y and estimates from stacked observations; under noise the estimates alone."""
    env, estimator = task.make(), WindowEstimator.read(path)
    whole: Any = env.observation_space
    size = whole.shape[0]
    entries = list(task.estimated_entries(size) if task.measurement_noise else task.told(size))
    low, high = whole.low[entries], whole.high[entries]
    if task.measurement_noise:  # estimates are not cut, as those of observers are not
        low, high = np.full_like(low, -np.inf), np.full_like(high, np.inf)
    if keep is not None:
        env = Recorder(env, **task.signals(size), keep=keep)
    stacked = Stacked(part_of(env, task.measured), task.frames)
    return WindowObservation(stacked, task, estimator, gym.spaces.Box(low, high, dtype=np.float32))


__all__ = ["WindowEstimator", "WindowObservation", "show_window"]
