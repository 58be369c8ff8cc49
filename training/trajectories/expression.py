"""A system's f, g and h as data that an artifact can hold."""

from collections.abc import Callable
from typing import Any

import numpy as np

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import System
from observers import Expression
from training.trajectories.derivatives import output_matrix

ROUNDING = 1e-6  # of a component's range: what may lie between two ways to evaluate it

# What sympy calls the functions that expressions know by other names.
_NAMES = {
    "Add": "+",
    "Mul": "*",
    "Pow": "**",
    "Mod": "%",
    "Abs": "abs",
    "Max": "maximum",
    "Min": "minimum",
    "StrictLessThan": "<",
    "LessThan": "<=",
    "StrictGreaterThan": ">",
    "GreaterThan": ">=",
    "And": "and",
    "Or": "or",
    "Not": "not",
}


def output_expression(system: System) -> Expression:
    """Write a system's output as an expression; ValueError with the reason if it cannot be written."""

    def traced(x: list[Any], u: list[Any]) -> Any:
        return components(system.h, x)

    return _expression(system, traced, lambda x, u: system.output(x), "h(x)", inputs=False)


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
        values = traced(x.T, u.T)
        return np.stack([np.broadcast_to(value, len(x)) for value in values], -1)

    return _expression(system, traced, evaluated, "f(x)" if not system.discrete else "step(x, u)", inputs=inputs)


def output_facts(system: System) -> dict[str, Any]:
    """The output of an artifact: C where h(x) = C x, else h as an expression, nothing where it cannot be written."""
    C = output_matrix(system)
    if C is not None:
        return {"C": C}
    try:
        return {"h": output_expression(system)}
    except ValueError:  # calibration says why
        return {}


def _expression(
    system: System,
    traced: Callable[[list[Any], list[Any]], Any],
    evaluated: Callable[[np.ndarray, np.ndarray], np.ndarray],
    what: str,
    *,
    inputs: bool,
) -> Expression:
    import sympy  # here, because it takes half a second that other commands need not wait for

    x, u = (list(sympy.symbols(f"{letter}:{n}", real=True)) for letter, n in (("x", system.nx), ("u", system.nu)))
    places = {symbol: (letter, i) for letter, symbols in (("x", x), ("u", u)) for i, symbol in enumerate(symbols)}
    try:
        found = Expression([_tree(sympy.sympify(value), places) for value in traced(x, u)])
        rng = np.random.default_rng(0)
        states = np.concatenate([system.draw_starts(rng, 100), system.draw_starts(rng, 100, 2.0)])
        acting = rng.uniform(-1, 1, (200, system.nu)) * np.array(system.u_max) * inputs
        with np.errstate(all="ignore"):
            expected = evaluated(states, acting)
        rounding = ROUNDING * np.nanmax(np.abs(expected), axis=0)
        if not np.isclose(found(states, acting), expected, rtol=1e-9, atol=rounding, equal_nan=True).all():
            raise ValueError("it is not the same on symbols as on arrays; write it with kkl_gym.elementary alone")
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"an observer of {system.name!r} cannot hold {what} as an expression: {error}") from error
    return found


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


__all__ = ["field_expression", "output_expression", "output_facts"]
