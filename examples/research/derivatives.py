"""Exact derivatives of a system's equations, by sympy."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kkl_gym.equations import components
from kkl_gym.system import Components

# NumPy versions of functions that some sympy releases cannot print as code, or print for arrays of one shape only.
_IN_NUMPY = {
    "largest": lambda *values: functools.reduce(np.maximum, values),
    "smallest": lambda *values: functools.reduce(np.minimum, values),
    "Heaviside": np.heaviside,
}


def jacobian(equations: Callable[[Components], Components], nx: int) -> list[dict[int, Callable[..., Any]]]:
    """Return derivatives of f or h: for each component, a dict from a state's index to the derivative, without zeros.

    At a kink, as of ``abs`` or ``maximum``, a derivative is the mean of the derivatives on both sides; at a jump it is
    the derivative beside the jump.
    """
    import sympy  # imported here, because it takes half a second

    x = sympy.symbols(f"x:{nx}", real=True)
    largest, smallest = sympy.Function("largest"), sympy.Function("smallest")
    rows = []
    for i, value in enumerate(components(equations, list(x))):
        value = _differentiable(sympy.sympify(value))
        row = {j: sympy.diff(value, symbol) for j, symbol in enumerate(x)}
        if any(derivative.has(sympy.Derivative) for derivative in row.values()):
            raise ValueError(f"component {i} of {equations.__name__}(x) has no derivative in sympy: {value}")
        row = {j: d.replace(sympy.Max, largest).replace(sympy.Min, smallest) for j, d in row.items() if d != 0}
        rows.append({j: sympy.lambdify(x, d, [_IN_NUMPY, "numpy"], cse=True) for j, d in row.items()})
    return rows


def _differentiable(value: Any) -> Any:
    """Rewrite functions with kinks and jumps so that sympy can differentiate them."""
    import sympy

    def flat(name: str) -> Any:
        return type(name, (sympy.Function,), {"fdiff": lambda self, argindex=1: sympy.Integer(0)})

    floor = flat("floor")
    value = value.replace(sympy.Mod, lambda a, b: a - b * floor(a / b)).replace(sympy.floor, floor)
    return value.replace(sympy.sign, flat("sign")).replace(sympy.Abs, lambda u: sympy.Max(u, -u))


@np.errstate(all="ignore")  # where(x > 0, log(x), 0) evaluates log for negative x, too
def evaluate(rows: Sequence[dict[int, Callable[..., Any]]], x: np.ndarray) -> np.ndarray:
    """Evaluate the result of :func:`jacobian` at states (..., nx); returns (..., rows, nx)."""
    out = np.zeros((*x.shape[:-1], len(rows), x.shape[-1]))
    for i, row in enumerate(rows):
        for j, derivative in row.items():
            out[..., i, j] = derivative(*np.moveaxis(x, -1, 0))
    return out
