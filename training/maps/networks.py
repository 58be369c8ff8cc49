"""Torch networks, and their conversion to and from the networks of artifacts."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
import torch
from scipy.linalg import block_diag
from torch import nn

from observers import MLP
from training.config import Config

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "silu": nn.SiLU, "relu": nn.ReLU}


class Network(nn.Sequential):
    """A multilayer perceptron, initialised with Glorot's normal weights and zero biases."""

    def __init__(self, inputs: int, outputs: int, *, width: int, depth: int, activation: str) -> None:
        widths = [inputs] + [width] * depth
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Linear(before, after), ACTIVATIONS[activation]()]
        super().__init__(*layers, nn.Linear(widths[-1], outputs))
        self.activation = activation
        for layer in self.linear_layers():
            nn.init.xavier_normal_(layer.weight)
            nn.init.zeros_(layer.bias)

    @classmethod
    def of(cls, config: Config, inputs: int, outputs: int) -> Self:
        """Make a network of the configured size."""
        return cls(inputs, outputs, width=config.width, depth=config.depth, activation=config.activation)

    def linear_layers(self) -> list[nn.Linear]:
        """Return the linear layers in order."""
        return [layer for layer in self if isinstance(layer, nn.Linear)]

    def export(self) -> MLP:
        """Return the same network for NumPy."""
        layers = self.linear_layers()
        return MLP(
            [layer.weight.detach().float().cpu().numpy() for layer in layers],
            [layer.bias.detach().float().cpu().numpy() for layer in layers],
            self.activation,
        )


def averaged(members: Sequence[MLP]) -> MLP:
    """Return the mean of networks of one shape as one network, with all their hidden neurons side by side."""
    first, *hidden, last = zip(*(member.weights for member in members), strict=True)
    *biases, offsets = zip(*(member.biases for member in members), strict=True)
    return MLP(
        [np.concatenate(first), *(block_diag(*blocks) for blocks in hidden), np.concatenate(last, 1) / len(members)],
        [*(np.concatenate(each) for each in biases), np.mean(offsets, 0)],
        members[0].activation,
    )


def compiled(function: Callable[..., Any], device: torch.device) -> Callable[..., Any]:
    """Compile a function and its derivatives to CUDA graphs with TF32 products; on a CPU return it unchanged."""
    if device.type != "cuda":
        return function
    torch.set_float32_matmul_precision("high")
    run = torch.compile(function, mode="reduce-overhead")
    return torch._dynamo.config.patch(suppress_errors=True)(run)  # runs uncompiled if the compiler fails


def tensor(x: np.ndarray, device: torch.device) -> torch.Tensor:
    """Return a float32 tensor on ``device``."""
    return torch.as_tensor(np.ascontiguousarray(x, dtype=np.float32), device=device)


def from_mlp(mlp: MLP, *, dtype: torch.dtype = torch.float32) -> nn.Sequential:
    """Convert a multilayer perceptron for NumPy to torch, with frozen weights."""
    layers: list[nn.Module] = []
    for weight, bias in zip(mlp.weights, mlp.biases, strict=True):
        layer = nn.Linear(weight.shape[1], weight.shape[0], dtype=dtype)
        layer.weight.data, layer.bias.data = (torch.as_tensor(values, dtype=dtype) for values in (weight, bias))
        layers += [layer, ACTIVATIONS[mlp.activation]()]
    return nn.Sequential(*layers[:-1]).requires_grad_(False)
