"""The algorithms of stable-baselines3 and sb3-contrib, and the networks of their policies in NumPy."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from observers import MLP
from training.agents.agent import LSTM, Head

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "ppo": PPO,
    "a2c": A2C,
    "dqn": DQN,
    "sac": SAC,
    "td3": TD3,
    "tqc": TQC,
    "ppo_lstm": RecurrentPPO,
}
CONTINUOUS = ("sac", "td3", "tqc")  # algorithms that need continuous actions within finite bounds
ACTIVATIONS: dict[type[nn.Module], str] = {nn.Tanh: "tanh", nn.ReLU: "relu", nn.SiLU: "silu"}


def head_of(algorithm: str, *, discrete: bool) -> Head:
    """Return the name of the function that turns the output of an algorithm's network into an action."""
    if discrete:
        return "argmax"
    return "tanh" if algorithm in CONTINUOUS else "clip"


def actor(model: BaseAlgorithm) -> list[nn.Module]:
    """Return the linear layers and activations of a model's deterministic policy in order, without any LSTM."""
    policy: Any = model.policy
    if isinstance(model, SAC | TQC):
        return [*policy.actor.latent_pi, policy.actor.mu]
    if isinstance(model, TD3):
        return list(policy.actor.mu)
    if isinstance(model, DQN):
        return list(policy.q_net.q_net)
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def perceptron(model: BaseAlgorithm) -> MLP:
    """Return a model's deterministic policy as a perceptron, without any LSTM."""
    body = actor(model)
    layers = [layer for layer in body if isinstance(layer, nn.Linear)]
    activation = next((ACTIVATIONS[type(layer)] for layer in body if type(layer) in ACTIVATIONS), "tanh")
    return MLP([_array(layer.weight) for layer in layers], [_array(layer.bias) for layer in layers], activation)


def lstm_in(weights: dict[str, torch.Tensor]) -> LSTM | None:
    """Return the LSTM in the tensors of a policy, or None if it has no LSTM."""
    parts = [weights.get(f"lstm_actor.{name}_l0") for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]
    if any(part is None for part in parts):
        return None
    ih, hh, bias_ih, bias_hh = (_array(part) for part in parts if part is not None)
    return LSTM(np.concatenate([ih, hh], axis=1), bias_ih + bias_hh)


def linear(start: float) -> Callable[[float], float]:
    """Return a schedule that falls linearly from ``start`` to zero in the course of a training."""
    # The last rollout may exceed the steps of the training; the remaining share is then negative.
    return lambda remaining: start * max(remaining, 0.0)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()
