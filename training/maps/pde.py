"""The equation that a forward map solves, dT/dx f(x) = A T(x) + B h(x), on tensors."""

from collections.abc import Callable

import torch
from torch import nn

from kkl_gym.equations import components
from kkl_gym.system import Components

TensorMap = Callable[[torch.Tensor], torch.Tensor]


def on_tensors(equations: Callable[[Components], Components], x: torch.Tensor) -> torch.Tensor:
    """A system's f or h, which take and give components, on states (n, nx), as (n, components)."""
    values = components(equations, x.unbind(-1))
    # A number becomes a tensor by a sum: a copy from the host would not be allowed in a CUDA graph.
    return torch.stack([(x.new_zeros(len(x)) + value).to(x.dtype) for value in values], -1)


def along(network: nn.Sequential, x: torch.Tensor, f: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Values of a network at x and their derivatives along f; by hand, as torch.compile has no forward mode."""
    for layer in network:
        if isinstance(layer, nn.Linear):
            x, f = layer(x), f @ layer.weight.T
        elif isinstance(layer, nn.Tanh):
            x = torch.tanh(x)
            f = (1 - x * x) * f
        elif isinstance(layer, nn.SiLU):
            gate = torch.sigmoid(x)
            f = gate * (1 + x * (1 - gate)) * f
            x = gate * x
        else:
            raise TypeError(f"no derivative of {type(layer).__name__} is implemented; use Linear, Tanh and SiLU layers")
    return x, f


def residual(
    value: torch.Tensor, derivative: torch.Tensor, *, h: torch.Tensor, A: torch.Tensor, B: torch.Tensor
) -> torch.Tensor:
    """Residual P(x) = dT/dx f - A T - B h at n states, from T (n, nz) and dT/dx f (n, nz)."""
    return derivative - value @ A.T - h @ B.T
