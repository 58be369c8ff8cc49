"""Trained agents for any environment: a policy in NumPy, with everything needed to play it."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np

from observers import MLP, storage
from observers.checks import choice, shown
from training.agents.agent import AgentError, fingerprint
from training.agents.any_environment.information import SHOWN, Shown, show
from training.agents.any_environment.task import HiddenTask

FORMAT = 1
KEY = "kkl-gym-player"
Head = Literal["tanh", "clip", "argmax"]
LARGEST_SCALED = 10.0  # of a normalised observation, as stable-baselines3 cuts it


@dataclass(frozen=True)
class Player:
    """A deterministic policy, the environment that it was trained in and what it is shown of it."""

    network: MLP
    head: Head
    task: HiddenTask
    information: Shown
    mean: np.ndarray | None = None
    scale: np.ndarray | None = None
    observer: str | None = None
    fingerprint: str | None = None
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, given, known in (("head", self.head, get_args(Head)), ("information", self.information, SHOWN)):
            try:
                choice(name, given, known)
            except ValueError as error:
                raise AgentError(str(error)) from None
        for name in ("observer", "fingerprint"):
            if not isinstance(getattr(self, name), str | None):
                raise AgentError(f"{name} must be a string, got {getattr(self, name)!r}")
        if (self.mean is None) != (self.scale is None):
            raise AgentError(f"mean and scale belong together, {'scale' if self.scale is None else 'mean'} is missing")
        for name, values in (("mean", self.mean), ("scale", self.scale)):
            if values is not None and (values.shape != (self.network.inputs,) or not np.isfinite(values).all()):
                raise AgentError(f"{name} must be {self.network.inputs} finite numbers, got {shown(values)}")
        if not isinstance(self.training, Mapping):
            raise AgentError(f"training must be a mapping, got {self.training!r}")

    def make(self, *, observer: str | None = None, env_id: str | None = None) -> gym.Env[np.ndarray, Any]:
        """Make the environment that the agent was trained in.

        An agent may come from a stranger's file, and to make an environment may import the module that its id names.
        So the id of an environment that is not Gymnasium's own does nothing unless the caller says it too.
        """
        named = self.task.env_id
        spec = gym.registry.get(named)
        own = spec is not None and str(spec.entry_point).startswith("gymnasium.envs.")
        if env_id != named and (env_id is not None or not own):
            raise AgentError(
                f"the agent's environment is {named!r}, and env_id={env_id!r}: give env_id={named!r} if you trust the "
                "agent's file with what that imports"
            )
        observer = observer or self.observer
        if observer is not None and fingerprint(observer) != self.fingerprint:
            raise AgentError(f"the agent was trained on another observer than what is in {observer!r} now")
        env = show(self.task, self.information, observer)
        wanted = (gym.spaces.flatdim(env.observation_space), gym.spaces.flatdim(env.action_space))
        if wanted != (self.network.inputs, self.network.outputs):
            raise AgentError(
                f"the policy has {self.network.inputs} inputs and {self.network.outputs} outputs, the environment "
                f"{wanted[0]} and {wanted[1]}"
            )
        if isinstance(env.action_space, gym.spaces.Discrete) != (self.head == "argmax"):
            raise AgentError(f"a policy whose head is {self.head} cannot act in {env.action_space}")
        return env

    def act(self, observation: np.ndarray, action_space: gym.Space[Any]) -> Any:
        """Act. Shapes: ``observation`` (width,) or (n, width)."""
        if self.mean is not None:
            observation = np.clip((observation - self.mean) / self.scale, -LARGEST_SCALED, LARGEST_SCALED)
        out = self.network(np.asarray(observation, dtype=np.float32))
        if isinstance(action_space, gym.spaces.Discrete):
            return out.argmax(-1) + int(action_space.start)
        space: Any = action_space
        if self.head == "tanh":
            out = space.low + (np.tanh(out) + 1.0) / 2.0 * (space.high - space.low)
        return np.clip(out, space.low, space.high).reshape(*out.shape[:-1], *space.shape)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write weights and description to one safetensors file, whole or not at all."""
        tensors: dict[str, np.ndarray] = {}
        storage.put_mlp(tensors, "", self.network)
        if self.mean is not None and self.scale is not None:
            tensors |= {"mean": self.mean, "scale": self.scale}
        described = {
            "format": FORMAT,
            "activation": self.network.activation,
            "head": self.head,
            "task": asdict(self.task),
            "information": self.information,
            "observer": self.observer,
            "fingerprint": self.fingerprint,
            "training": dict(self.training),
        }
        storage.save(path, tensors, key=KEY, described=described)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "Player":
        """Read an agent."""
        tensors, described = storage.read(path, key=KEY, error=AgentError, what="an agent for any environment")
        with storage.explained(path, AgentError):
            if described.pop("format") != FORMAT:
                raise AgentError(f"it has another format than {FORMAT}, which kkl-gym reads: train the agent again")
            network = storage.get_mlp(tensors, "", described.pop("activation"))
            task: dict[str, Any] = described.pop("task")
            return cls(
                network=network,
                task=HiddenTask(**task),
                mean=tensors.get("mean"),
                scale=tensors.get("scale"),
                **described,
            )


__all__ = ["KEY", "Head", "Player"]
