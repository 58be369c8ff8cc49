"""A system's output h(x) as data that an artifact can hold."""

from typing import Any

import numpy as np

from kkl_gym.equations import components
from kkl_gym.system import System
from observers import Expression

ROUNDING = 1e-6  # of an output's range: what may lie between two ways to evaluate it

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
    """Write a system's output as an expression."""
    import sympy  # here, because it takes half a second that other commands need not wait for

    x = list(sympy.symbols(f"x:{system.nx}", real=True))
    try:
        found = Expression([_tree(sympy.sympify(value), x) for value in components(system.h, x)])
        states = system.draw_starts(np.random.default_rng(0), 100)
        rounding = ROUNDING * np.array(system.output_range)
        if not np.isclose(found(states), system.output(states), rtol=1e-9, atol=rounding, equal_nan=True).all():
            raise ValueError("it is not the same on symbols as on arrays; write it with kkl_gym.elementary alone")
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(
            f"the observer of {system.name!r} cannot hold h(x), without which it neither judges samples nor predicts "
            f"those that are missing: {error}"
        ) from error
    return found


def _tree(value: Any, x: list[Any]) -> Any:
    """A sympy expression as :class:`observers.Expression` takes it."""
    if value in x:
        return ["x", x.index(value)]
    if getattr(value, "is_number", False):
        return float(value)
    name = type(value).__name__
    if name == "Piecewise":
        *pieces, (otherwise, last) = value.args
        if str(last) != "True":
            raise ValueError(f"{value} is not defined everywhere")
        tree = _tree(otherwise, x)
        for piece, condition in reversed(pieces):
            tree = ["where", _tree(condition, x), _tree(piece, x), tree]
        return tree
    return [_NAMES.get(name, name), *(_tree(argument, x) for argument in value.args)]
