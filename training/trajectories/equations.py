"""A system's equations differentiated, and written as data that an artifact can hold."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import Components, System
from observers import Expression

LINEAR_ROUNDING = 1e-9  # of an output's size: what may be left of a linear one
EXPRESSION_ROUNDING = 1e-6  # of a component's range: what may lie between two ways to evaluate it

# What sympy calls the functions that expressions know by other names.
_NAMES = {
    "Add": "+", "Mul": "*", "Pow": "**", "Mod": "%", "Abs": "abs", "Max": "maximum", "Min": "minimum",
    "StrictLessThan": "<", "LessThan": "<=", "StrictGreaterThan": ">", "GreaterThan": ">=",
    "And": "and", "Or": "or", "Not": "not",
}  # fmt: skip

# Functions in the derivatives that some releases of sympy do not print for NumPy, or for arrays of one shape only.
_IN_NUMPY = {
    "largest": lambda *values: functools.reduce(np.maximum, values),
    "smallest": lambda *values: functools.reduce(np.minimum, values),
    "Heaviside": np.heaviside,
}


def jacobian(equations: Callable[[Components], Components], nx: int) -> list[dict[int, Callable[..., Any]]]:
    """Derivatives of f or h from its own equations: for each component, those that are not zero by state.

    At a kink, as of ``abs`` or ``maximum``, a derivative is the mean of those on both sides; at a jump it is that
    beside it.
    """
    import sympy  # here, because it takes half a second that other commands need not wait for

    x = sympy.symbols(f"x:{nx}", real=True)
    largest, smallest = sympy.Function("largest"), sympy.Function("smallest")
    rows = []
    for i, value in enumerate(components(equations, list(x))):
        value = _differentiable(sympy.sympify(value))
        row = {j: sympy.diff(value, symbol) for j, symbol in enumerate(x)}
        if any(derivative.has(sympy.Derivative) for derivative in row.values()):
            raise ValueError(f"component {i} of {equations.__name__}(x) has no derivative that sympy knows: {value}")
        row = {j: d.replace(sympy.Max, largest).replace(sympy.Min, smallest) for j, d in row.items() if d != 0}
        rows.append({j: sympy.lambdify(x, d, [_IN_NUMPY, "numpy"], cse=True) for j, d in row.items()})
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
    at, nx, nu = np.array(x, dtype=float), system.nx, system.nu
    C = evaluate(jacobian(system.h, nx), at)
    if system.discrete:

        def moved(both: Components) -> Components:
            return components(system.step, both[:nx], both[nx:])

        both = evaluate(jacobian(moved, nx + nu), np.concatenate([at, np.zeros(nu)]))
        return both[:, :nx], both[:, nx:], C
    return evaluate(jacobian(system.f, nx), at), np.array(input_matrix(system, x), dtype=float).reshape(nx, nu), C


def output_matrix(system: System) -> np.ndarray | None:
    """C, (ny, nx), if the output is h(x) = C x, else None."""
    x = system.draw_starts(np.random.default_rng(0), 100)
    with np.errstate(all="ignore"):  # of ratios and logarithms, which need not exist at 0 and 1
        C, y = system.output(np.eye(system.nx)).T, system.output(x)
        linear = np.abs(y - x @ C.T) <= LINEAR_ROUNDING * np.abs(y).max(0)
    return C if linear.all() else None


def output_facts(system: System) -> dict[str, Any]:
    """The output of an artifact: C where h(x) = C x, else h as an expression, nothing where it cannot be written."""
    C = output_matrix(system)
    if C is not None:
        return {"C": C}
    try:
        return {"h": output_expression(system)}
    except ValueError:  # calibration says why
        return {}


def output_expression(system: System) -> Expression:
    """Write a system's output as an expression; ValueError with the reason if it cannot be written."""
    return _expression(
        system, lambda x, u: components(system.h, x), lambda x, u: system.output(x), "h(x)", inputs=False
    )


def field_expression(system: System, *, inputs: bool = True) -> Expression:
    """Write f(x) + g(x) u, or step(x, u), as an expression; ValueError with the reason if it cannot be written."""
    nu = system.nu

    def traced(x: Any, u: Any) -> list[Any]:
        u = list(u) if inputs else [0.0] * nu
        if system.discrete:
            return list(components(system.step, x, u))
        f, rows = components(system.f, x), input_matrix(system, x) if nu else [()] * len(x)
        return [fi + sum(gij * uj for gij, uj in zip(row, u, strict=True)) for fi, row in zip(f, rows)]

    def evaluated(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack([np.broadcast_to(value, len(x)) for value in traced(x.T, u.T)], -1)

    return _expression(system, traced, evaluated, "step(x, u)" if system.discrete else "f(x)", inputs=inputs)


def _expression(
    system: System,
    traced: Callable[[list[Any], list[Any]], Any],
    evaluated: Callable[[np.ndarray, np.ndarray], np.ndarray],
    what: str,
    *,
    inputs: bool,
) -> Expression:
    import sympy

    x, u = (list(sympy.symbols(f"{letter}:{n}", real=True)) for letter, n in (("x", system.nx), ("u", system.nu)))
    places = {symbol: (letter, i) for letter, symbols in (("x", x), ("u", u)) for i, symbol in enumerate(symbols)}
    rng = np.random.default_rng(0)
    try:
        expression = Expression([_tree(sympy.sympify(value), places) for value in traced(x, u)])
        states = np.concatenate([system.draw_starts(rng, 100), system.draw_starts(rng, 100, 2.0)])
        acting = rng.uniform(-1, 1, (200, system.nu)) * np.array(system.u_max) * inputs
        with np.errstate(all="ignore"):
            expected = evaluated(states, acting)
        rounding = EXPRESSION_ROUNDING * np.nanmax(np.abs(expected), axis=0)
        if not np.isclose(expression(states, acting), expected, rtol=1e-9, atol=rounding, equal_nan=True).all():
            raise ValueError("it is not the same on symbols as on arrays; write it with kkl_gym.elementary alone")
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"an observer of {system.name!r} cannot hold {what} as an expression: {error}") from error
    return expression


def _tree(value: Any, places: dict[Any, tuple[str, int]]) -> Any:
    """A sympy expression as :class:`observers.Expression` takes it."""
    if value in places:
        return list(places[value])
    if getattr(value, "is_number", False):
        return float(value)
    name = type(value).__name__
    if name == "Piecewise":
        *pieces, (otherwise, last) = value.args
        if str(last) != "True":
            raise ValueError(f"{value} is not defined everywhere")
        tree = _tree(otherwise, places)
        for piece, condition in reversed(pieces):
            tree = ["where", _tree(condition, places), _tree(piece, places), tree]
        return tree
    return [_NAMES.get(name, name), *(_tree(argument, places) for argument in value.args)]
