"""Derivatives of a system from its own equations."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import Box, Components, System

# Functions in the derivatives that sympy does not print for NumPy, or prints for arrays of one shape only.
_IN_NUMPY = {
    "Max": lambda *values: functools.reduce(np.maximum, values),
    "Min": lambda *values: functools.reduce(np.minimum, values),
    "Heaviside": np.heaviside,
}


def jacobian(equations: Callable[[Components], Components], nx: int) -> list[dict[int, Callable[..., Any]]]:
    """Derivatives of f or h from its own equations.

    At a kink, as of ``abs`` or ``maximum``, a derivative is the mean of those on both sides; at a jump it is that
    beside it.

    Parameters
    ----------
    equations : callable
        A system's f or h.
    nx : int
        Number of states.

    Returns
    -------
    list of dict
        For each component the derivatives that are not zero, as functions of the states by index of the state.

    Raises
    ------
    EquationError
        If the equations do not take sympy symbols.
    ValueError
        If sympy cannot differentiate them.
    """
    import sympy  # here, because it takes half a second that other commands need not wait for

    x = sympy.symbols(f"x:{nx}", real=True)
    rows = []
    for i, value in enumerate(components(equations, list(x))):
        value = _differentiable(sympy.sympify(value))
        derivatives = {j: sympy.diff(value, x[j]) for j in range(nx)}
        if any(derivative.has(sympy.Derivative) for derivative in derivatives.values()):
            raise ValueError(f"component {i} of {equations.__name__}(x) has no derivative that sympy knows: {value}")
        rows.append({j: sympy.lambdify(x, d, [_IN_NUMPY, "numpy"], cse=True) for j, d in derivatives.items() if d != 0})
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
    """Linearise a system at a state x: df/dx (nx, nx), g (nx, nu) and dh/dx (ny, nx)."""
    g = np.array(input_matrix(system, x), dtype=float).reshape(system.nx, system.nu)
    at = np.array(x, dtype=float)
    return evaluate(jacobian(system.f, system.nx), at), g, evaluate(jacobian(system.h, system.nx), at)


def with_sensitivity(system: System, driven: bool = True) -> System:
    """Put a system beside its variational equation, x' = f(x) + g(x) u and Phi' = d(f + g u)/dx Phi.

    Parameters
    ----------
    system : System
        The system.
    driven : bool, default True
        Whether it keeps its inputs.

    Returns
    -------
    System
        One whose states are x and then Phi row by row.

    Raises
    ------
    ValueError
        If f, or a g that depends on the state, does not take sympy symbols.
    """
    nx, rows = system.nx, jacobian(system.f, system.nx)
    nu = system.nu if driven else 0
    varying = nu > 0 and type(system).g is not System.g

    def entries(x: Components) -> Components:
        return [entry for row in input_matrix(system, x) for entry in row]

    input_rows = jacobian(entries, nx) if varying else []

    def carried(row: dict[int, Callable[..., Any]], x: Components) -> list[Any]:
        """A row of derivatives by the states, times Phi."""
        at = {k: derivative(*x[:nx]) for k, derivative in row.items()}
        return [sum(value * x[nx + k * nx + j] for k, value in at.items()) for j in range(nx)]

    class Sensitivity(System):
        name = f"{system.name}-sensitivity"
        X: ClassVar[Box] = (*system.X, *((0.0, 1.0),) * nx**2)
        bounds: ClassVar[Box] = (*system.bounds, *((-1e9, 1e9),) * nx**2)
        u_max: ClassVar[tuple[float, ...]] = system.u_max if driven else ()
        G: ClassVar[tuple[tuple[float, ...], ...]] = (*system.G, *((0.0,) * nu,) * nx**2) if nu and not varying else ()

        def f(self, x: Components) -> Components:
            return [*system.f(x[:nx]), *(value for row in rows for value in carried(row, x))]

        if varying:

            def g(self, x: Components) -> Sequence[Components]:
                by_input = [[carried(input_rows[i * nu + m], x) for m in range(nu)] for i in range(nx)]
                return [*system.g(x[:nx]), *(column for row in by_input for column in zip(*row, strict=True))]

        def rate(self, x: Components) -> Any:
            return system.rate(x[:nx])

    return Sensitivity()


def output_matrix(system: System) -> np.ndarray | None:
    """C, (ny, nx), if the output is h(x) = C x, else None."""
    C = system.output(np.eye(system.nx)).T
    x = system.draw_starts(np.random.default_rng(0), 100)
    return C if np.allclose(system.output(x), x @ C.T, rtol=1e-9, atol=1e-12) else None
