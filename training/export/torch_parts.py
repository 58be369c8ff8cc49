"""Networks, expressions, tables and factors as functions of Torch that export, compile and differentiate."""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from observers.expression import Expression
from observers.network import MLP

_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"tanh": torch.tanh, "silu": functional.silu, "relu": torch.relu}
LEAST_PIVOT = 1e-30  # a variance of scaled states
# Those that take numbers beside tensors as they are; the others get tensors in their place.
_OPERATORS = {"+": operator.add, "*": operator.mul, "**": operator.pow, "%": operator.mod}
_OPERATORS |= {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}
_FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    **{name: getattr(torch, name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "abs", "sign")},
    **{name: getattr(torch, name) for name in ("floor", "atan2", "minimum", "maximum", "where")},
    **{name: getattr(torch, f"logical_{name}") for name in ("and", "or", "not")},
}


class Module(nn.Module):
    """A module with buffers of doubles."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    def put(self, **arrays: np.ndarray) -> None:
        """Add buffers."""
        for name, values in arrays.items():
            self.register_buffer(name, torch.tensor(np.asarray(values, dtype=float)))


class Network(Module):
    """A multilayer perceptron: rows (n, inputs) to (n, outputs)."""

    def __init__(self, mlp: MLP, dtype: torch.dtype) -> None:
        super().__init__()
        layers = ([nn.Parameter(torch.tensor(np.asarray(each), dtype=dtype)) for each in part] for part in mlp.layers)
        self.weights, self.biases = (nn.ParameterList(parts) for parts in zip(*layers, strict=True))
        self._active = _ACTIVATIONS[mlp.activation]

    def forward(self, h: Tensor) -> Tensor:
        """Evaluate in the type of the weights; returns the type that was given."""
        kind, h = h.dtype, h.to(self.weights[0].dtype)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = torch.addmm(bias, self._active(h) if i else h, weight)
        return h.to(kind)


def evaluated(expression: Expression, **columns: Sequence[Tensor]) -> Tensor:
    """The components (k, ...) of states "x" and inputs "u", which are sequences of tensors (...)."""
    like = columns["x"][0]
    values: dict[Any, Any] = {}

    def value(part: Any) -> Any:
        if not isinstance(part, tuple):
            return part
        if part not in values:
            name, *arguments = part
            values[part] = columns[name][arguments[0]] if name in columns else operated(name, *map(value, arguments))
        return values[part]

    def operated(name: str, *given: Any) -> Any:
        if name not in _OPERATORS or not any(isinstance(each, Tensor) for each in given):
            given = tuple(map(tensor, given))
        function = _OPERATORS.get(name) or _FUNCTIONS[name]
        return function(*given) if name == "where" or len(given) == 1 else functools.reduce(function, given)

    def tensor(given: Any) -> Tensor:
        return given if isinstance(given, Tensor) else torch.zeros_like(like) + given

    return torch.stack([tensor(value(part)).expand_as(like) for part in expression.components])


def between(at: Tensor, points: Tensor, values: Tensor) -> Tensor:
    """Values (k, m) at rising points (k,), interpolated at (n, 1): (n, m); beyond the last its value stays."""
    if len(points) == 1:
        return values[..., 0, :]
    passed = ((at - points[:-1]) / (points[1:] - points[:-1])).clamp(0.0, 1.0)
    return values[..., 0, :] + (passed[..., None, :] @ (values[..., 1:, :] - values[..., :-1, :]))[..., 0, :]


def product(a: Tensor, b: Tensor) -> Tensor:
    """A B^T of matrices (i, k, n) and (j, k, n): (i, j, n)."""
    return (a[:, None] * b[None]).sum(2)


def eliminated(P: Tensor, *rows: Tensor, skipped: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """L and B L^-T, one above the other, of covariances P = L L^T (m, m, n) and matrices B (k, m, n) of more rows.

    Columns are 0 where they are skipped, (m, n). Returns also where P is positive definite, (n,). Where it is not,
    pivots are replaced by small ones, so that gradients stay finite. Above its diagonal L holds rounding errors.
    """
    rest = torch.cat([P, *rows]) if rows else P
    columns: list[Tensor] = []
    pivots: list[Tensor] = []
    for j in range(len(P)):
        pivot = rest[j, j]
        column = rest[:, j] / pivot.clamp(min=LEAST_PIVOT).sqrt()
        if skipped is not None:
            column, pivot = torch.where(skipped[j], 0.0, column), torch.where(skipped[j], 1.0, pivot)
        columns.append(column)
        pivots.append(pivot)
        if j + 1 < len(P):
            rest = rest - column[:, None] * column[: len(P)]
    return torch.stack(columns, 1), torch.stack(pivots).amin(0) > 0
