"""Derivatives of a system from its own equations."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import Box, Components, System

LARGEST = 1e9  # entry of Phi, with each state in units of X's width, beyond which a motion is lost
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


def with_sensitivity(system: System, driven: bool = True) -> System:
    """Put a system beside its variational equation, x' = f(x) + g(x) u and Phi' = d(f + g u)/dx Phi.

    In discrete time the next Phi is that of the step, d step/dx Phi. A motion whose Phi grows beyond LARGEST is lost.
    """
    nx, nu = system.nx, system.nu if driven else 0
    low, high = system.box()
    units = np.divide.outer(high - low, high - low).ravel().tolist()  # of Phi's entries
    box: Box = (*system.X, *((0.0, unit) for unit in units))
    limits: Box = (*system.bounds, *((-LARGEST * unit, LARGEST * unit) for unit in units))
    inputs = system.u_max if driven else ()
    joint = f"{system.name}-sensitivity"
    if system.discrete:
        moves = _of_step(system)

        class Stepping(System):
            name = joint
            X: ClassVar[Box] = box
            bounds: ClassVar[Box] = limits
            u_max: ClassVar[tuple[float, ...]] = inputs
            dt = system.dt

            def step(self, x: Components, u: Components) -> Components:
                acting = u if nu else (0.0,) * system.nu
                return [*system.step(x[:nx], acting), *_times(moves, (*x[:nx], *acting), x[nx:])]

        return Stepping()
    rows = jacobian(system.f, nx)
    steered = bool(nu) and type(system).g is not System.g
    columns = [_of_column(system, j) for j in range(nu)] if steered else []

    class Sensitivity(System):
        name = joint
        X: ClassVar[Box] = box
        bounds: ClassVar[Box] = limits
        u_max: ClassVar[tuple[float, ...]] = inputs
        G: ClassVar[tuple[tuple[float, ...], ...]] = (*system.G, *((0.0,) * nu,) * nx**2) if nu and not steered else ()

        def f(self, x: Components) -> Components:
            state = x[:nx]
            return [*system.f(state), *_times(rows, state, x[nx:])]

        if steered:

            def g(self, x: Components) -> Sequence[Components]:
                state = x[:nx]
                return [*system.g(state), *zip(*(_times(column, state, x[nx:]) for column in columns), strict=True)]

        def rate(self, x: Components) -> Any:
            return system.rate(x[:nx])

    return Sensitivity()


def _of_column(system: System, j: int) -> list[dict[int, Callable[..., Any]]]:
    """Derivatives of a column of the input matrix, by state."""

    def column(x: Components) -> Components:
        return [row[j] for row in input_matrix(system, x)]

    return jacobian(column, system.nx)


def _times(rows: Sequence[dict[int, Callable[..., Any]]], at: Components, Phi: Components) -> list[Any]:
    """Derivatives by the state, of as many components as it has, times Phi, row by row."""
    nx, out = len(rows), list[Any]()
    # Rows of Phi are multiplied as one where they are arrays, since each operation costs as much as its work.
    blocks = [Phi[k * nx : (k + 1) * nx] for k in range(nx)]
    for row in rows:
        values = {k: derivative(*at) for k, derivative in row.items() if k < nx}
        if isinstance(Phi, np.ndarray):
            total = sum(value * blocks[k] for k, value in values.items())
            out += list(total) if values else [0] * nx
        else:
            out += [sum(value * blocks[k][j] for k, value in values.items()) for j in range(nx)]
    return out


def output_matrix(system: System) -> np.ndarray | None:
    """C, (ny, nx), if the output is h(x) = C x, else None."""
    x = system.draw_starts(np.random.default_rng(0), 100)
    with np.errstate(all="ignore"):  # of ratios and logarithms, which need not exist at 0 and 1
        C, y = system.output(np.eye(system.nx)).T, system.output(x)
        linear = np.abs(y - x @ C.T) <= ROUNDING * np.abs(y).max(0)
    return C if linear.all() else None
