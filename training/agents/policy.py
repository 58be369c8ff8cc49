"""What all agents of stable-baselines3 have here: policies as perceptrons, and schedules that end at zero."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sb3_contrib import TQC
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from observers import MLP

ACTIVATIONS: dict[type[nn.Module], str] = {nn.Tanh: "tanh", nn.ReLU: "relu", nn.SiLU: "silu"}


def perceptron(model: BaseAlgorithm) -> MLP:
    """Take the layers of the deterministic policy out of a trained agent."""
    body = actor(model)
    layers = [layer for layer in body if isinstance(layer, nn.Linear)]
    activation = next((ACTIVATIONS[type(layer)] for layer in body if type(layer) in ACTIVATIONS), "tanh")
    return MLP([_array(layer.weight) for layer in layers], [_array(layer.bias) for layer in layers], activation)


def actor(model: BaseAlgorithm) -> list[nn.Module]:
    """The modules of an agent's deterministic policy, linear ones and activations, in their order."""
    policy: Any = model.policy
    if isinstance(model, SAC | TQC):
        return [*model.actor.latent_pi, model.actor.mu]
    if isinstance(model, TD3):
        return list(model.actor.mu)
    if isinstance(model, DQN):
        return list(policy.q_net.q_net)
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def linear(start: float) -> Callable[[float], float]:
    """Make a schedule that ends at zero."""
    return lambda remaining: start * max(remaining, 0.0)  # the last rollout ends past the last step


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()
