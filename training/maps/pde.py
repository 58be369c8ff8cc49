"""The equation that a forward map solves, dT/dx f(x) = A T(x) + B h(x), on tensors."""

from collections.abc import Callable

import torch

from kkl_gym.equations import components
from kkl_gym.system import Components

TensorMap = Callable[[torch.Tensor], torch.Tensor]


def on_tensors(equations: Callable[[Components], Components], x: torch.Tensor) -> torch.Tensor:
    """A system's f or h, which take and give components, on states (n, nx), as (n, components)."""
    values = components(equations, x.unbind(-1))
    return torch.stack([torch.as_tensor(value, dtype=x.dtype, device=x.device).expand(len(x)) for value in values], -1)


def along(T: TensorMap, x: torch.Tensor, f: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Values (n, nz) of a map and its derivatives along a vector field."""
    value, derivative = torch.func.jvp(T, (x,), (f,))  # type: ignore[misc]
    return value, derivative


def residual(
    T: TensorMap, x: torch.Tensor, *, f: torch.Tensor, h: torch.Tensor, A: torch.Tensor, B: torch.Tensor
) -> torch.Tensor:
    """How far a map is from solving the equation, P(x) = dT/dx f - A T - B h, at n states: (n, nz)."""
    value, derivative = along(T, x, f)
    return derivative - value @ A.T - h @ B.T
