"""Trained agents: a policy in NumPy, with everything needed to play it."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np

from kkl_gym import SYSTEMS, get_system
from kkl_gym.wrappers.vector import VectorEnv
from observers import MLP, storage
from observers.checks import ArtifactError, choice, shown
from observers.names import matching, resolve
from training.agents.information import INFORMATION, Information, make
from training.agents.tasks import Task
from training.trajectories.equations import describe

FORMAT = 2  # version of the file format
KEY = "kkl-gym-agent"
MAX_SCALED = 10.0  # largest size of a normalised observation's entries, in units of ``scale``, as in stable-baselines3
Head = Literal["tanh", "clip", "argmax"]


class AgentError(ValueError):
    """Raised for an invalid or corrupt agent file, and for an agent that does not fit its environment or observer."""


@dataclass(frozen=True)
class LSTM:
    """One layer of long short-term memory, with PyTorch's order of gates.

    Shapes: ``weight`` (4 k, inputs + k), ``bias`` (4 k,); a state is (h, c), each (n, k).
    """

    weight: np.ndarray
    bias: np.ndarray

    @property
    def size(self) -> int:
        """Number of cells, k."""
        return len(self.bias) // 4

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.weight.shape[1] - self.size

    def __call__(self, x: np.ndarray, state: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the state that follows ``state`` under the inputs ``x`` (n, inputs)."""
        i, f, g, o = np.split(np.concatenate([x, state[0]], axis=1) @ self.weight.T + self.bias, 4, axis=1)
        c = _sigmoid(f) * state[1] + _sigmoid(i) * np.tanh(g)
        return _sigmoid(o) * np.tanh(c), c


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)))


@dataclass(frozen=True)
class Agent:
    """A deterministic policy, the task on which it was trained, and the information that it sees.

    ``mean`` and ``scale``, both of shape (inputs,), normalise observations.
    """

    network: MLP
    head: Head
    task: Task
    information: Information
    mean: np.ndarray | None = None
    scale: np.ndarray | None = None
    lstm: LSTM | None = None
    observer: str | None = None
    fingerprint: str | None = None
    rules: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, known in (("head", get_args(Head)), ("information", INFORMATION)):
            try:
                choice(name, getattr(self, name), known)
            except ValueError as error:
                raise AgentError(str(error)) from None
        for name in ("observer", "fingerprint"):
            if not isinstance(getattr(self, name), str | None):
                raise AgentError(f"{name} must be a string, got {getattr(self, name)!r}")
        if (self.mean is None) != (self.scale is None):
            raise AgentError(f"mean and scale belong together; {'scale' if self.scale is None else 'mean'} is missing")
        for name in ("mean", "scale"):
            values = getattr(self, name)
            if values is not None and (values.shape != (self.inputs,) or not np.isfinite(values).all()):
                raise AgentError(f"{name} must be {self.inputs} finite numbers, got {shown(values)}")
        if self.lstm is not None and (
            self.lstm.weight.shape != (4 * self.lstm.size, self.inputs + self.lstm.size)
            or self.lstm.size != self.network.inputs
        ):
            raise AgentError(f"the lstm's weight {self.lstm.weight.shape} does not fit its bias and the network")
        for name in ("rules", "training"):
            if not isinstance(getattr(self, name), Mapping):
                raise AgentError(f"{name} must be a mapping, got {getattr(self, name)!r}")
        if type(self.seed) is not int:
            raise AgentError(f"the seed must be a whole number, got {self.seed!r}")

    @property
    def seed(self) -> int:
        """Seed of the training, or 0 if it is unknown."""
        return self.training.get("seed", 0)

    @property
    def inputs(self) -> int:
        """Size of the observations that the policy takes."""
        return self.network.inputs if self.lstm is None else self.lstm.inputs

    def policy(self, action_space: gym.Space[Any]) -> Callable[[np.ndarray], Any]:
        """Return a function from observations (n, inputs) to n actions; recurrent agents need a new one per episode."""
        space: Any = action_space
        memory: tuple[np.ndarray, np.ndarray] | None = None

        def act(observation: np.ndarray) -> Any:
            nonlocal memory
            if self.mean is not None:
                observation = np.clip((observation - self.mean) / self.scale, -MAX_SCALED, MAX_SCALED)
            out = np.asarray(observation, dtype=np.float32)
            if self.lstm is not None:
                if memory is None:
                    memory = (np.zeros((len(out), self.lstm.size), np.float32),) * 2
                memory = self.lstm(out, memory)
                out = memory[0]
            out = self.network(out)
            if isinstance(space, gym.spaces.Discrete):
                return out.argmax(-1) + int(space.start)
            low, high = space.low.ravel(), space.high.ravel()
            if self.head == "tanh":
                out = (low + high) / 2 + (high - low) / 2 * np.tanh(out)
            return np.clip(out, low, high).reshape(*out.shape[:-1], *space.shape)

        return act

    def make(self, num_envs: int = 1, *, trusted: str | None = None, observer: str | None = None) -> VectorEnv:
        """Make environments of the agent's task; ``observer`` is the path of the agent's observer if that has moved.

        The agent's file may be untrusted, and making its environment may import a module or script that this file
        names. An environment that neither Gymnasium nor kkl_gym ships is therefore made only if ``trusted`` names it.
        """
        named = self.task.system or self.task.env_id
        spec = gym.registry.get(named)
        harmless = named in SYSTEMS or (spec is not None and str(spec.entry_point).startswith("gymnasium.envs."))
        if trusted != named and (trusted is not None or not harmless):
            raise AgentError(
                f"the agent's environment is {named!r}, but trusted is {trusted!r}: making it may import code that "
                f"the agent's file names; trust {named!r} if you trust this code"
            )
        observer = observer or self.observer
        if observer is not None and fingerprint(observer) != self.fingerprint:
            raise AgentError(f"the agent was not trained with the observer {observer!r}")
        now = rules(self.task)
        for name in now:
            if self.rules.get(name) != now[name]:
                raise AgentError(f"the agent was trained with {name} = {self.rules.get(name)}; it is now {now[name]}")
        env = make(self.task, self.information, num_envs, observer=observer)
        sizes = tuple(map(gym.spaces.flatdim, (env.single_observation_space, env.single_action_space)))
        if sizes != (self.inputs, self.network.outputs):
            raise AgentError(
                f"the policy has {self.inputs} inputs and {self.network.outputs} outputs, but the environment needs "
                f"{sizes[0]} and {sizes[1]}"
            )
        if isinstance(env.single_action_space, gym.spaces.Discrete) != (self.head == "argmax"):
            raise AgentError(f"a policy whose head is {self.head} cannot act in {env.single_action_space}")
        return env

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the agent to one safetensors file, atomically."""
        tensors: dict[str, np.ndarray] = {}
        storage.put_mlp(tensors, "", self.network)
        if self.mean is not None and self.scale is not None:
            tensors |= {"mean": self.mean, "scale": self.scale}
        if self.lstm is not None:
            tensors |= {"lstm.weight": self.lstm.weight, "lstm.bias": self.lstm.bias}
        task = asdict(self.task)
        if (weights := task.pop("weights")) is not None:
            tensors["memory.weights"] = np.array(weights)
        described = {
            "format": FORMAT,
            "activation": self.network.activation,
            "head": self.head,
            "task": task,
            "information": self.information,
            "observer": self.observer,
            "fingerprint": self.fingerprint,
            "rules": dict(self.rules),
            "training": dict(self.training),
        }
        storage.save(path, tensors, key=KEY, described=described)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "Agent":
        """Read an agent from its file."""
        tensors, described = storage.read(path, key=KEY, error=AgentError, what="an agent")
        with storage.explained(path, AgentError):
            if (number := described.pop("format")) != FORMAT:
                raise AgentError(f"it has format {number!r}, but kkl-gym reads format {FORMAT}: train the agent again")
            known = {entry.name for entry in fields(cls)} - {"network", "mean", "scale", "lstm"}
            if unknown := sorted(described.keys() - known - {"activation"}):
                raise AgentError(f"unknown metadata keys: {', '.join(unknown)}")
            network = storage.get_mlp(tensors, "", described.pop("activation"))
            lstm = LSTM(tensors["lstm.weight"], tensors["lstm.bias"]) if "lstm.weight" in tensors else None
            task = Task(**described.pop("task"), weights=tensors.get("memory.weights"))
            return cls(network, task=task, mean=tensors.get("mean"), scale=tensors.get("scale"), lstm=lstm, **described)


def rules(task: Task) -> dict[str, Any]:
    """Return the equations, target, scale and process noise of the task's system, on which an agent depends."""
    if task.system is None:
        return {}
    system = get_system(task.system)
    described = {
        "equations": describe(system)["equations"],
        "target": system.target,
        "scale": system.scale,
        "process_noise": system.process_noise,
    }
    return dict(json.loads(json.dumps(described)))


def fingerprint(observer: str) -> str:
    """Return the checksum of an observer's file."""
    try:
        return storage.checksum(resolve(observer), ArtifactError)
    except ArtifactError as error:
        raise AgentError(f"the agent's observer cannot be read: {error}") from error


def find(name: str) -> Path:
    """Return the path of a shipped agent by its name; a name that ends in .safetensors is itself the path."""
    if name.endswith(".safetensors"):
        return Path(name)
    folder = files("training.agents").joinpath("shipped")
    names = sorted(entry.name.removesuffix(".safetensors") for entry in folder.iterdir())
    if (known := matching(name, names)) is None:
        raise AgentError(f"no agent {name!r} ships, only {', '.join(names)}; a file's name must end in .safetensors")
    return Path(str(folder.joinpath(f"{known}.safetensors")))
