"""Trained agents: a policy in NumPy, with everything needed to play it."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from kkl_gym import SYSTEMS, System, get_system
from observers import MLP, storage
from observers.errors import ArtifactError
from observers.names import resolve
from training.agents.information import EKF_PROCESS_NOISE, INFORMATION, OBSERVED, STACKED, Features, Information, make
from training.agents.tasks import ControlTask
from training.jobs import describe

FORMAT = 1
_KEY = "kkl-gym-agent"


class AgentError(ValueError):
    """A file that is no agent, or an agent that does not fit what it is to be played with."""


@dataclass(frozen=True)
class Agent:
    """A deterministic policy, the task it was trained on and what it knows of the state."""

    network: MLP
    squashed: bool
    task: ControlTask
    information: Information
    observer: str | None = None
    fingerprint: str | None = None
    rules: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.squashed, bool):
            raise AgentError(f"squashed must be a bool, got {self.squashed!r}")
        if self.information not in INFORMATION:
            raise AgentError(f"an agent knows one of {', '.join(INFORMATION)}, got {self.information!r}")
        if not isinstance(self.task.system, str):
            raise AgentError(f"the task's system must be a name, got {self.task.system!r}")
        for name in ("observer", "fingerprint"):
            if not isinstance(getattr(self, name), str | None):
                raise AgentError(f"{name} must be a string, got {getattr(self, name)!r}")
        for name in ("rules", "training"):
            if not isinstance(getattr(self, name), Mapping):
                raise AgentError(f"{name} must be a mapping, got {getattr(self, name)!r}")
        if type(self.seed) is not int:  # it becomes part of the names of files
            raise AgentError(f"the seed must be a whole number, got {self.seed!r}")

    @property
    def seed(self) -> int:
        """Seed of the training; 0 if nobody said."""
        return self.training.get("seed", 0)

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Act. Shapes: ``obs`` (n, width); returns (n, nu)."""
        action = self.network(obs)
        bounded: np.ndarray = np.tanh(action) if self.squashed else np.clip(action, -1.0, 1.0)
        return bounded

    def make(
        self,
        num_envs: int,
        autoreset_mode: str | AutoresetMode = AutoresetMode.DISABLED,
        *,
        system: str | System | type[System] | None = None,
    ) -> Features:
        """Make the environment that the agent was trained in.

        An agent may come from a stranger's file, and to make a system of a name imports the module or the script that
        it names. So the name of a system that does not ship does nothing unless the caller says it too.
        """
        task = self.task
        if not isinstance(system, str | None):
            task = replace(task, system=get_system(system))
        elif system not in (None, task.system) or (system is None and task.system not in SYSTEMS):
            raise AgentError(
                f"the agent's system is {task.system!r}, and system={system!r}: give system={task.system!r} if you "
                "trust the agent's file with what that imports, or give the class"
            )
        if self.information in OBSERVED and self.observer is None:
            raise AgentError(f"an agent that knows {self.information} must name its observer")
        if self.observer is not None and fingerprint(self.observer) != self.fingerprint:
            raise AgentError(
                f"the observer {self.observer!r} is not the one that the agent was trained on: its file has changed"
            )
        now = rules(task)
        for name in now:
            if self.rules.get(name) != now[name]:
                raise AgentError(f"the agent was trained with {name} = {self.rules.get(name)}; it is {now[name]} now")
        env = make(task, self.information, num_envs, autoreset_mode=autoreset_mode, observer=self.observer)
        sizes = (env.single_observation_space.shape[0], env.single_action_space.shape[0])  # type: ignore[index]
        if sizes != (self.network.inputs, self.network.outputs):
            raise AgentError(
                f"the policy has {self.network.inputs} inputs and {self.network.outputs} outputs, the task {sizes}"
            )
        return env

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write weights and description to one safetensors file, whole or not at all."""
        tensors: dict[str, np.ndarray] = {}
        storage.put_mlp(tensors, "", self.network)
        described = {
            "format": FORMAT,
            "activation": self.network.activation,
            "squashed": self.squashed,
            "task": asdict(self.task),
            "information": self.information,
            "observer": self.observer,
            "fingerprint": self.fingerprint,
            "rules": dict(self.rules),
            "training": dict(self.training),
        }
        storage.save(path, tensors, key=_KEY, described=described)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "Agent":
        """Read an agent."""
        tensors, described = storage.read(path, key=_KEY, error=AgentError, what="an agent")
        with storage.explained(path, AgentError):
            if (number := described.pop("format")) != FORMAT:
                raise AgentError(f"it has format {number!r}, kkl-gym reads {FORMAT}: train the agent again")
            if unknown := sorted(described.keys() - {"activation", *(entry.name for entry in fields(cls))}):
                raise AgentError(f"unknown metadata keys: {', '.join(unknown)}")
            network = storage.get_mlp(tensors, "", described.pop("activation"))
            task = described.pop("task")
            if task["start_box"] is not None:
                task["start_box"] = tuple(tuple(ends) for ends in task["start_box"])
            if isinstance(task["measurement_noise"], list):
                task["measurement_noise"] = tuple(task["measurement_noise"])
            return cls(network=network, task=ControlTask(**task), **described)


def rules(task: ControlTask) -> dict[str, Any]:
    """Return what an agent's observations follow from beside its task and observer."""
    system = get_system(task.system)
    described = {
        "equations": describe(system)["equations"],
        "target": system.target,
        "scale": system.scale,
        "process_noise": system.process_noise,
        "stacked": STACKED,
        "ekf_process_noise": EKF_PROCESS_NOISE,
    }
    return dict(json.loads(json.dumps(described)))


def fingerprint(observer: str) -> str:
    """Return the checksum of an observer's file."""
    try:
        return storage.checksum(resolve(observer), ArtifactError)
    except ArtifactError as error:
        raise AgentError(f"the agent's observer cannot be read: {error}") from error
