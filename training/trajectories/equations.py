"""A system's equations: linearisation, fingerprints, and expressions that an artifact can hold."""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import Components, System
from observers import Expression

ASIDE = 1e-5  # step of the central differences: in widths of X for a state, in u_max for an input
LINEAR_ROUNDING = 1e-9  # largest residual of a linear output, as a share of its largest value
EXPRESSION_ROUNDING = 1e-6  # largest difference of expression and equations, as a share of a component's largest value

# Sympy's names of functions, and the names that expressions give them.
_NAMES = {
    "Add": "+", "Mul": "*", "Pow": "**", "Mod": "%", "Abs": "abs", "Max": "maximum", "Min": "minimum",
    "StrictLessThan": "<", "LessThan": "<=", "StrictGreaterThan": ">", "GreaterThan": ">=",
    "And": "and", "Or": "or", "Not": "not",
}  # fmt: skip


def describe(system: System) -> dict[str, Any]:
    """Return the identity of a system, with a hash of the values of its equations at points of X."""
    rng = np.random.default_rng(0)
    x = system.draw_starts(rng, 20)
    if system.discrete:
        u = rng.uniform(-1, 1, (system.nu, 20)) * np.array(system.u_max)[:, None]
        moved = components(system.step, x.T, u)
    else:
        moved = [*components(system.f, x.T), *(entry for row in input_matrix(system, x.T) for entry in row)]
    equations = [_rounded(np.broadcast_to(row, 20)).tolist() for row in (*moved, *system.output(x).T)]
    return {
        "system": system.name,
        "parameters": system.parameters,
        "X": system.X,
        "bounds": system.bounds,
        "u_max": system.u_max,
        "equations": digest(equations),
    }


def digest(values: Sequence[Any]) -> str:
    """Return a hash of numbers in nested lists."""
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def _rounded(values: np.ndarray) -> np.ndarray:
    """Round to six decimals, or to more if all values are small, so that all machines agree."""
    size = np.abs(values).max()
    return np.round(values, 6 - min(0, math.floor(math.log10(size))) if 0 < size < np.inf else 6)


def linearised(system: System, x: Components) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Jacobians at x and u = 0: A (nx, nx) and B (nx, nu) of f + g u, or of the step, and C (ny, nx) of h."""
    low, high = system.box()
    nx, at, sizes = system.nx, np.array(x, dtype=float), high - low

    def slopes(equations: Callable[[Components], Components], at: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        aside = ASIDE * sizes * np.eye(len(at))
        ahead, behind = (components(equations, list((at + each).T)) for each in (aside, -aside))
        return np.stack([np.broadcast_to(a - b, len(at)) for a, b in zip(ahead, behind)]) / (2 * ASIDE * sizes)

    C = slopes(system.h, at, sizes)
    if not system.discrete:
        return slopes(system.f, at, sizes), np.array(input_matrix(system, x), dtype=float).reshape(nx, system.nu), C
    both, widths = np.append(at, np.zeros(system.nu)), np.append(sizes, system.u_max)
    moved = slopes(lambda both: components(system.step, both[:nx], both[nx:]), both, widths)
    return moved[:, :nx], moved[:, nx:], C


def output_matrix(system: System) -> np.ndarray | None:
    """Return C (ny, nx) if the output is h(x) = C x, else None."""
    x = system.draw_starts(np.random.default_rng(0), 100)
    with np.errstate(all="ignore"):  # ratios and logarithms may be undefined at 0 and 1
        C, y = system.output(np.eye(system.nx)).T, system.output(x)
        return C if (np.abs(y - x @ C.T) <= LINEAR_ROUNDING * np.abs(y).max(0)).all() else None


def output_facts(system: System) -> dict[str, Any]:
    """Return Artifact's argument for the output: C if h(x) = C x, else h as an expression (or raise ValueError)."""
    C = output_matrix(system)
    return {"h": output_expression(system)} if C is None else {"C": C}


def output_expression(system: System) -> Expression:
    """Write a system's output as an expression; ValueError with the reason if this is impossible."""
    return _expression(system, lambda x, u: components(system.h, x), lambda x, u: system.output(x), "h(x)")


def field_expression(system: System, *, inputs: bool = True) -> Expression:
    """Write f(x) + g(x) u, or step(x, u), as an expression; ValueError with the reason if this is impossible."""
    nu = system.nu

    def traced(x: Any, u: Any) -> list[Any]:
        u = list(u) if inputs else [0.0] * nu
        if system.discrete:
            return list(components(system.step, x, u))
        f, rows = components(system.f, x), input_matrix(system, x) if nu else [()] * len(x)
        return [fi + sum(gij * uj for gij, uj in zip(row, u, strict=True)) for fi, row in zip(f, rows)]

    def evaluated(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack([np.broadcast_to(value, len(x)) for value in traced(x.T, u.T)], -1)

    what = "step(x, u)" if system.discrete else "f(x) + g(x) u" if nu else "f(x)"
    return _expression(system, traced, evaluated, what, inputs=inputs)


def _expression(
    system: System,
    traced: Callable[[list[Any], list[Any]], Any],
    evaluated: Callable[[np.ndarray, np.ndarray], np.ndarray],
    what: str,
    *,
    inputs: bool = False,
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
            raise ValueError("its values for symbols and arrays differ; use only the functions of kkl_gym.elementary")
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"an observer of {system.name!r} cannot hold {what} as an expression: {error}") from error
    return expression


def _tree(value: Any, places: dict[Any, tuple[str, int]]) -> Any:
    """Convert a sympy expression to the nested lists of :class:`observers.Expression`."""
    if value in places:
        return list(places[value])
    if getattr(value, "is_number", False):
        return float(value)
    name = type(value).__name__
    if name == "Piecewise":
        if str(value.args[-1][1]) != "True":
            raise ValueError(f"{value} is not defined everywhere")
        tree = _tree(value.args[-1][0], places)
        for piece, condition in value.args[-2::-1]:
            tree = ["where", _tree(condition, places), _tree(piece, places), tree]
        return tree
    return [_NAMES.get(name, name), *(_tree(argument, places) for argument in value.args)]
