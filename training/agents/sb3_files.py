"""Agents as stable-baselines3's own files, AGENT.zip, and back, without unpickling any."""

import io
import json
import os
import re
import zipfile
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from kkl_gym import System, get_system
from observers import MLP
from observers.storage import explained
from training.agents.agent import Agent, AgentError, fingerprint, rules
from training.agents.bridge import SB3VecEnv
from training.agents.information import observer_of
from training.agents.policy import ACTIVATIONS, actor
from training.agents.tasks import get_task

_LAYERS = {  # of the deterministic policy in a file of each algorithm
    False: re.compile(r"mlp_extractor\.policy_net\.\d+|action_net"),
    True: re.compile(r"actor\.latent_pi\.\d+|actor\.mu"),
}
_LARGEST = 1 << 28  # bytes of a policy, unpacked


def to_sb3(agent: Agent, *, system: str | System | None = None) -> BaseAlgorithm:
    """Make an agent of stable-baselines3 that acts as this one; its ``save`` writes the zip.

    Its value functions are not trained, since agents are kept without: it is for playing, not for training on.
    """
    network = agent.network
    activation = {name: module for module, name in ACTIVATIONS.items()}[network.activation]
    kwargs = {"net_arch": [len(bias) for bias in network.biases[:-1]], "activation_fn": activation}
    env = SB3VecEnv(agent.make(1, "SameStep", system=system))
    options: dict[str, Any] = {"policy_kwargs": kwargs, "device": "cpu"}
    model: BaseAlgorithm = (
        SAC("MlpPolicy", env, buffer_size=1, **options) if agent.squashed else PPO("MlpPolicy", env, **options)
    )
    layers = [layer for layer in actor(model) if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        for layer, weight, bias in zip(layers, network.weights, network.biases, strict=True):
            layer.weight.copy_(torch.from_numpy(np.array(weight)))
            layer.bias.copy_(torch.from_numpy(np.array(bias)))
    return model


def from_sb3(path: str | os.PathLike[str], system: str | System, observer: str | None = None) -> Agent:
    """Read an agent that stable-baselines3 or rl-zoo3 has trained on :class:`training.agents.OnTask`.

    Of the file, its tensors and its text are read; what is pickled in it stays so.
    """
    with explained(path, AgentError):
        try:
            with zipfile.ZipFile(path) as files:
                if max(files.getinfo(name).file_size for name in ("policy.pth", "data")) > _LARGEST:
                    raise AgentError(f"a policy of more than {_LARGEST >> 20} MiB is none of ours")
                weights = torch.load(io.BytesIO(files.read("policy.pth")), map_location="cpu", weights_only=True)
                described = json.loads(files.read("data"))
        except (KeyError, zipfile.BadZipFile, RuntimeError, UnpicklingError) as error:
            raise AgentError(f"it is no agent of stable-baselines3: {error}") from error
        except OSError as error:
            raise AgentError(f"it cannot be read: {error.strerror}") from error
        squashed = any(name.startswith("actor.") for name in weights)
        names = [name.removesuffix(".weight") for name in weights if name.endswith(".weight")]
        layers = [name for name in names if _LAYERS[squashed].fullmatch(name)]
        if len(layers) < 2:
            raise AgentError(f"it holds no perceptron of PPO or SAC, but {', '.join(names)}")
        network = MLP(
            [weights[f"{name}.weight"].numpy() for name in layers],
            [weights[f"{name}.bias"].numpy() for name in layers],
            _activation(described, squashed),
        )
    task, named = get_task(system), (observer or observer_of(get_system(system)))
    agent = Agent(
        network=network,
        squashed=squashed,
        task=task,
        information="x_hat",
        observer=named,
        fingerprint=fingerprint(named),
        rules=rules(task),
        training={"algorithm": "sac" if squashed else "ppo", "from": os.path.basename(path)},
    )
    agent.make(1, system=system).close()  # which says whether it fits
    return agent


def _activation(described: dict[str, Any], squashed: bool) -> str:
    """What is between the layers: named in the text that stands beside the pickled settings, or the default."""
    said = str(described.get("policy_kwargs", {}).get("activation_fn", "ReLU" if squashed else "Tanh"))
    for module, name in ACTIVATIONS.items():
        if said.rpartition(".")[2].removesuffix("'>") == module.__name__:
            return name
    raise AgentError(f"the activation {said} is none of {', '.join(m.__name__ for m in ACTIVATIONS)}")


__all__ = ["from_sb3", "to_sb3"]
