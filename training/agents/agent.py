"""Trained agents: a policy in NumPy, with everything needed to play it."""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from kkl_gym import get_system
from observers import MLP
from observers.artifact import ArtifactError, resolve, shipped
from training.agents.information import EKF_PROCESS_NOISE, INFORMATION, STACKED, Features, Information, make
from training.jobs import describe
from training.systems import ControlTask

FORMAT = 1


_KEY = "kkl-gym-agent"


class AgentError(ValueError):
    """A file that is no agent, or an agent that does not fit what it is to be played with."""


@dataclass(frozen=True)
class Agent:
    """A deterministic policy, the task it was trained on and what it knows of the state.

    network : features in, actions out.
    squashed : whether tanh bounds the actions (SAC) or a cut at -1 and 1 (PPO).
    task : where it acts.
    information : what it is shown.
    observer : name and version of the shipped map, or path of the file, that it was trained on; None without.
    fingerprint : SHA-256 of that file.
    rules : what else its observations follow from, see :func:`rules`.
    training : how it was trained.
    """

    network: MLP
    squashed: bool
    task: ControlTask
    information: Information
    observer: str | None = None
    fingerprint: str | None = None
    rules: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Features (n, width) in, actions (n, nu) in [-1, 1] out."""
        action = self.network(obs)
        bounded: np.ndarray = np.tanh(action) if self.squashed else np.clip(action, -1.0, 1.0)
        return bounded

    def make(self, num_envs: int, autoreset_mode: str | AutoresetMode = AutoresetMode.DISABLED) -> Features:
        """The environment that the agent was trained in.

        Raises AgentError if its observer, the system's equations or what its observations are made of have changed, or
        the policy does not fit the environment.
        """
        if self.information in ("x_hat", "z") and self.observer is None:
            raise AgentError(f"an agent that knows {self.information} must name its observer")
        if self.observer is not None and fingerprint(self.observer) != self.fingerprint:
            raise AgentError(f"the agent was trained on another version of the observer {self.observer!r}")
        now = rules(self.task)
        for name in now:
            if self.rules.get(name) != now[name]:
                raise AgentError(f"the agent was trained with {name} = {self.rules.get(name)}; it is {now[name]} now")
        env = make(self.task, self.information, num_envs, autoreset_mode=autoreset_mode, observer=self.observer)
        sizes = (env.single_observation_space.shape[0], env.single_action_space.shape[0])  # type: ignore[index]
        if sizes != (self.network.inputs, self.network.outputs):
            raise AgentError(
                f"the policy has {self.network.inputs} inputs and {self.network.outputs} outputs, the task {sizes}"
            )
        return env

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write weights and description to one safetensors file, whole or not at all."""
        tensors: dict[str, np.ndarray] = {}
        for i, (weight, bias) in enumerate(zip(self.network.weights, self.network.biases, strict=True)):
            tensors |= {f"{i}.weight": np.ascontiguousarray(weight), f"{i}.bias": np.ascontiguousarray(bias)}
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
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{target.name}.{os.getpid()}.new")
        save_file(tensors, temporary, metadata={_KEY: json.dumps(described, sort_keys=True, allow_nan=False)})
        os.replace(temporary, target)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "Agent":
        """Read an agent; raises AgentError if the file is missing, damaged, foreign or of a newer format."""
        if not Path(path).is_file():
            raise AgentError(f"there is no file {path}")
        try:
            with safe_open(path, framework="numpy") as opened:
                text = (opened.metadata() or {}).get(_KEY)
                tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        except (SafetensorError, OSError, TypeError) as error:
            raise AgentError(f"{path} is damaged or no safetensors file: {error}") from error
        if text is None:
            raise AgentError(f"{path} is no agent of kkl-gym: it carries no {_KEY!r} metadata")
        try:
            described = json.loads(text)
            if described.pop("format") != FORMAT:
                raise AgentError(f"{path} has another format than {FORMAT}, which this version of kkl-gym reads")
            layers = range(len(tensors) // 2)
            network = MLP(
                [tensors[f"{i}.weight"] for i in layers],
                [tensors[f"{i}.bias"] for i in layers],
                described.pop("activation"),
            )
            task = described.pop("task")
            if task["start_box"] is not None:
                task["start_box"] = tuple(tuple(ends) for ends in task["start_box"])
            if described["information"] not in INFORMATION:
                raise AgentError(f"{path} knows {described['information']!r}, none of {', '.join(INFORMATION)}")
            return cls(network=network, task=ControlTask(**task), **described)
        except AgentError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise AgentError(f"{path} is incomplete: {error!r}") from error


def rules(task: ControlTask) -> dict[str, Any]:
    """What an agent's observations follow from beside its task and observer: equations, target, scale, constants."""
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


def versioned(observer: str) -> str:
    """A shipped name with its version, so that it stays the same map for good; a path as it is."""
    return observer if observer.endswith(".safetensors") else shipped().get(observer, observer)


def fingerprint(observer: str) -> str:
    """SHA-256 of an observer's file; raises AgentError if there is none."""
    try:
        return hashlib.sha256(resolve(observer).read_bytes()).hexdigest()
    except (OSError, ArtifactError) as error:
        raise AgentError(f"the agent's observer cannot be read: {error}") from error
