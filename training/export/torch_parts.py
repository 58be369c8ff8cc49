"""Parts of observers in Torch: networks, expressions, interpolation and Cholesky factors."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from observers.expression import Expression
from observers.network import MLP
from training.maps.networks import from_mlp

LEAST_PIVOT = 1e-30  # lower bound of the pivots (variances) by whose roots a Cholesky factorisation divides


def _of_tensors(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Return a version of ``function`` that also takes bools, and numbers, which become doubles."""

    def tensor(value: Any) -> Tensor:
        return torch.tensor(value, dtype=torch.bool if isinstance(value, bool) else torch.float64)

    return lambda *arguments: function(*(each if isinstance(each, Tensor) else tensor(each) for each in arguments))


# Torch's functions under NumPy's names, which the source of expressions calls.
_SAME = "sin cos tan exp log sqrt tanh abs sign floor minimum maximum where arctan2 logical_and logical_or logical_not"
_FUNCTIONS = {name: getattr(torch, name) for name in _SAME.split()} | {"power": torch.pow, "mod": torch.remainder}
_NUMPY = SimpleNamespace(**{name: _of_tensors(function) for name, function in _FUNCTIONS.items()})


class Module(nn.Module):
    """A module whose buffers are doubles."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    def put(self, **arrays: np.ndarray) -> None:
        """Add arrays as buffers."""
        for name, values in arrays.items():
            self.register_buffer(name, torch.tensor(np.asarray(values, dtype=float)))


class Network(Module):
    """A multilayer perceptron, which maps (n, inputs) to (n, outputs)."""

    def __init__(self, mlp: MLP, dtype: torch.dtype) -> None:
        super().__init__()
        self.layers: Any = from_mlp(mlp, dtype=dtype).requires_grad_(True)

    def forward(self, h: Tensor) -> Tensor:
        """Evaluate in the type of the weights; the result has the type of ``h``."""
        result: Tensor = self.layers(h.to(self.layers[0].weight.dtype))
        return result.to(h.dtype)


class TorchExpression(Expression):
    """An expression that maps tensors of states (nx, ...) and inputs (nu, ...) to its components (k, ...)."""

    _numpy = _NUMPY

    def __call__(self, x: Tensor, u: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """Evaluate the expression."""
        rows = [*x[: self.states], *(() if u is None else u[: self.inputs])]
        return torch.stack([(torch.zeros_like(x[0]) + value).to(x.dtype) for value in self._function(*rows)])


def between(at: Tensor, points: Tensor, values: Tensor) -> Tensor:
    """Return values (n, m) at ``at`` (n, 1): linear between points (k,) with values ([n,] k, m), constant beyond."""
    if len(points) == 1:
        return values[..., 0, :]
    passed = ((at - points[:-1]) / (points[1:] - points[:-1])).clamp(0.0, 1.0)
    return values[..., 0, :] + (passed[..., None, :] @ (values[..., 1:, :] - values[..., :-1, :]))[..., 0, :]


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return the products A B^T (i, j, n) of n matrices A (i, k, n) and B (j, k, n)."""
    return (a[:, None] * b[None]).sum(2)


def eliminated(P: Tensor, *rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the Cholesky factors L of covariances P = L L^T (m, m, n), stacked on B L^-T for B = ``rows`` (k, m, n).

    Also returns a mask (n,) of the P that are positive definite. LEAST_PIVOT replaces smaller pivots, so that gradients
    stay finite. Entries of L above the diagonal are rounding errors.
    """
    rest, columns, pivots = torch.cat([P, *rows]), [], []
    for j in range(len(P)):
        pivots.append(rest[j, 0])
        columns.append(rest[:, 0] / rest[j, 0].clamp(min=LEAST_PIVOT).sqrt())
        rest = rest[:, 1:] - columns[j][:, None] * columns[j][j + 1 : len(P)]
    return torch.stack(columns, 1), torch.stack(pivots).amin(0) > 0
