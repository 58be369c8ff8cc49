"""Derivatives of a system from its own equations."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import Components, System

ROUNDING = 1e-9  # of an output's size: what may be left of a linear one

# Functions in the derivatives that some releases of sympy do not print for NumPy, or for arrays of one shape only.
_IN_NUMPY = {
    "largest": lambda *values: functools.reduce(np.maximum, values),
    "smallest": lambda *values: functools.reduce(np.minimum, values),
    "Heaviside": np.heaviside,
}


def jacobian(equations: Callable[[Components], Components], nx: int) -> list[dict[int, Callable[..., Any]]]:
    """Derivatives of f or h from its own equations.

    At a kink, as of ``abs`` or ``maximum``, a derivative is the mean of those on both sides; at a jump it is that
    beside it.
    """
    import sympy  # here, because it takes half a second that other commands need not wait for

    x = sympy.symbols(f"x:{nx}", real=True)
    rows = []
    for i, value in enumerate(components(equations, list(x))):
        value = _differentiable(sympy.sympify(value))
        derivatives = {j: sympy.diff(value, x[j]) for j in range(nx)}
        if any(derivative.has(sympy.Derivative) for derivative in derivatives.values()):
            raise ValueError(f"component {i} of {equations.__name__}(x) has no derivative that sympy knows: {value}")
        printable = {
            j: d.replace(sympy.Max, sympy.Function("largest")).replace(sympy.Min, sympy.Function("smallest"))
            for j, d in derivatives.items()
        }
        rows.append({j: sympy.lambdify(x, d, [_IN_NUMPY, "numpy"], cse=True) for j, d in printable.items() if d != 0})
    return rows


def _differentiable(value: Any) -> Any:
    """An expression in which functions with kinks and jumps are written so that sympy knows their derivatives."""
    import sympy

    def flat(name: str) -> Any:
        return type(name, (sympy.Function,), {"fdiff": lambda self, argindex=1: sympy.Integer(0)})

    floor = flat("floor")
    for function, real in (
        (sympy.Mod, lambda a, b: a - b * floor(a / b)),
        (sympy.floor, floor),
        (sympy.sign, flat("sign")),
        (sympy.Abs, lambda u: sympy.Max(u, -u)),
    ):
        value = value.replace(function, real)
    return value


@np.errstate(all="ignore")  # where(x > 0, log(x), 0) is evaluated on both sides of zero
def evaluate(rows: Sequence[dict[int, Callable[..., Any]]], x: np.ndarray) -> np.ndarray:
    """Evaluate what :func:`jacobian` returned at states (..., nx), as (..., rows, nx)."""
    out = np.zeros((*x.shape[:-1], len(rows), x.shape[-1]))
    for i, row in enumerate(rows):
        for j, derivative in row.items():
            out[..., i, j] = derivative(*np.moveaxis(x, -1, 0))
    return out


def linearised(system: System, x: Components) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linearise a system at a state x without input: df/dx (nx, nx), g (nx, nu) and dh/dx (ny, nx).

    In discrete time the first two are the derivatives of the step.
    """
    at, nx = np.array(x, dtype=float), system.nx
    C = evaluate(jacobian(system.h, nx), at)
    if system.discrete:
        both = evaluate(_of_step(system), np.concatenate([at, np.zeros(system.nu)]))
        return both[:, :nx], both[:, nx:], C
    g = np.array(input_matrix(system, x), dtype=float).reshape(nx, system.nu)
    return evaluate(jacobian(system.f, nx), at), g, C


def _of_step(system: System) -> list[dict[int, Callable[..., Any]]]:
    """Derivatives of a step in discrete time, by state and then by input."""

    def moved(both: Components) -> Components:
        return components(system.step, both[: system.nx], both[system.nx :])

    return jacobian(moved, system.nx + system.nu)


def output_matrix(system: System) -> np.ndarray | None:
    """C, (ny, nx), if the output is h(x) = C x, else None."""
    x = system.draw_starts(np.random.default_rng(0), 100)
    with np.errstate(all="ignore"):  # of ratios and logarithms, which need not exist at 0 and 1
        C, y = system.output(np.eye(system.nx)).T, system.output(x)
        linear = np.abs(y - x @ C.T) <= ROUNDING * np.abs(y).max(0)
    return C if linear.all() else None
