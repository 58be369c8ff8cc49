"""Conversion of agents to and from the files of stable-baselines3 (AGENT.zip); code in a file is never run."""

import io
import json
import os
import re
import zipfile
from pickle import UnpicklingError
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from kkl_gym import get_system
from observers import MLP
from observers.storage import explained
from training.agents.agent import Agent, AgentError, fingerprint, rules
from training.agents.bridge import SB3VecEnv
from training.agents.information import OBSERVED, Information, make, observer_of
from training.agents.policy import ACTIVATIONS, ALGORITHMS, CONTINUOUS, actor, head_of, lstm_in
from training.agents.tasks import Task

# Names of the deterministic policy's layers by algorithm; TQC has the names of SAC, and A2C those of PPO.
_LAYERS = {
    "sac": re.compile(r"actor\.latent_pi\.\d+|actor\.mu"),
    "td3": re.compile(r"actor\.mu\.\d+"),
    "dqn": re.compile(r"q_net\.q_net\.\d+"),
    "ppo": re.compile(r"mlp_extractor\.policy_net\.\d+|action_net"),
}
_MAX_BYTES = 1 << 28  # largest size in bytes of an unpacked file in the zip


def to_sb3(agent: Agent, *, trusted: str | None = None) -> BaseAlgorithm:
    """Make a model of stable-baselines3 that acts like ``agent``; the model's ``save`` writes the zip.

    The model can play but not continue to learn: its critics, or DQN's target network, are untrained. Its first layer
    includes the normalisation of observations, without VecNormalize's clip at ±10.
    """
    network = agent.network
    hidden = [len(bias) for bias in network.biases[:-1]]
    activation = {name: module for module, name in ACTIVATIONS.items()}[network.activation]
    options: dict[str, Any] = {"policy_kwargs": {"net_arch": hidden, "activation_fn": activation}, "device": "cpu"}
    name = agent.training.get("algorithm")
    if name not in ALGORITHMS:
        raise AgentError(f"the agent's algorithm must be one of {', '.join(ALGORITHMS)}, got {name!r}")
    if name in (*CONTINUOUS, "dqn"):
        options["buffer_size"] = 1
    if agent.lstm is not None:
        options["policy_kwargs"] |= {"lstm_hidden_size": agent.lstm.size}
    policy = "MlpPolicy" if agent.lstm is None else "MlpLstmPolicy"
    model: BaseAlgorithm = ALGORITHMS[name](policy, SB3VecEnv(agent.make(trusted=trusted)), **options)
    first = agent.network.weights[0] if agent.lstm is None else agent.lstm.weight[:, : agent.inputs]
    offset = np.zeros(len(first))
    if agent.mean is not None:
        first = first / agent.scale
        offset = -first @ agent.mean
    layers = [layer for layer in actor(model) if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        for layer, weight, bias in zip(layers, network.weights, network.biases, strict=True):
            layer.weight.copy_(torch.from_numpy(np.array(weight)))
            layer.bias.copy_(torch.from_numpy(np.array(bias)))
        if agent.lstm is None:
            layers[0].weight.copy_(torch.from_numpy(np.array(first)))
            layers[0].bias.add_(torch.from_numpy(offset))
        else:
            cells: Any = model.policy.lstm_actor
            cells.weight_ih_l0.copy_(torch.from_numpy(np.array(first)))
            cells.weight_hh_l0.copy_(torch.from_numpy(np.array(agent.lstm.weight[:, agent.inputs :])))
            cells.bias_ih_l0.copy_(torch.from_numpy(agent.lstm.bias + offset))
            cells.bias_hh_l0.zero_()
    return model


def from_sb3(
    path: str | os.PathLike[str], task: Task, information: Information = "x_hat", observer: str | None = None
) -> Agent:
    """Read an agent that stable-baselines3 or rl-zoo3 has trained on a task without the wrapper VecNormalize.

    Only the file's tensors (by torch with ``weights_only``) and its text are read, so none of its code runs.
    """
    if task.system is not None and information in OBSERVED and observer is None:
        observer = observer_of(get_system(task.system))
    with explained(path, AgentError):
        weights, described = _content(path)
        names = [name.removesuffix(".weight") for name in weights if name.endswith(".weight")]
        layers_of = {known: [name for name in names if layer.fullmatch(name)] for known, layer in _LAYERS.items()}
        algorithm = next((known for known, layers in layers_of.items() if len(layers) > 1), None)
        if algorithm is None:
            raise AgentError(f"it holds no policy of {', '.join(ALGORITHMS)}; its layers are {', '.join(names)}")
        layers = layers_of[algorithm]
        network = MLP(
            [weights[f"{name}.weight"].numpy() for name in layers],
            [weights[f"{name}.bias"].numpy() for name in layers],
            _activation(described, "Tanh" if algorithm == "ppo" else "ReLU"),
        )
        lstm = lstm_in(weights)
        env = make(task, information, 1, observer=observer)
        discrete = isinstance(env.single_action_space, gym.spaces.Discrete)
        env.close()
        agent = Agent(
            network,
            head_of(algorithm, discrete=discrete),
            task,
            information,
            lstm=lstm,
            observer=observer,
            fingerprint=None if observer is None else fingerprint(observer),
            rules=rules(task),
            training={"algorithm": algorithm if lstm is None else "ppo_lstm", "from": os.path.basename(path)},
        )
        # Making the environment raises AgentError if the agent does not fit it.
        agent.make(trusted=task.system or task.env_id).close()
    return agent


def _content(path: str | os.PathLike[str]) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return a policy's tensors and settings from a zip; pickled settings are left as text."""
    try:
        with zipfile.ZipFile(path) as files:
            if max(files.getinfo(name).file_size for name in ("policy.pth", "data")) > _MAX_BYTES:
                raise AgentError(f"its policy or settings exceed {_MAX_BYTES >> 20} MiB")
            weights = torch.load(io.BytesIO(files.read("policy.pth")), map_location="cpu", weights_only=True)
            return weights, json.loads(files.read("data"))
    except (KeyError, zipfile.BadZipFile, RuntimeError, UnpicklingError) as error:
        raise AgentError(f"it is not an agent of stable-baselines3: {error}") from error
    except OSError as error:
        raise AgentError(f"it cannot be read: {error.strerror}") from error


def _activation(described: dict[str, Any], default: str) -> str:
    """Return the activation between the layers, from the text that is stored beside pickled settings."""
    named = str(described.get("policy_kwargs", {}).get("activation_fn", default))
    for module, name in ACTIVATIONS.items():
        if named.rpartition(".")[2].removesuffix("'>") == module.__name__:
            return name
    raise AgentError(f"the activation {named} is unknown; known are {', '.join(m.__name__ for m in ACTIVATIONS)}")
