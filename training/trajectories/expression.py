"""A system's output h(x) as data that an artifact can hold."""

from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import Expression

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
    """Write a system's output as an expression.

    Parameters
    ----------
    system : System
        Any system whose h takes sympy symbols.

    Returns
    -------
    Expression
        Of the states, with the system's parameters as numbers.

    Raises
    ------
    ValueError
        If h does not take symbols, or is beyond what expressions can say; the message says what to write instead.
    """
    import sympy  # here, because it takes half a second that other commands need not wait for

    x = sympy.symbols(f"x:{system.nx}", real=True)
    try:
        values = [sympy.sympify(value) for value in system.h(list(x))]
        found = Expression([_tree(value, list(x)) for value in values])
    except Exception as error:  # whatever a user's equations raise
        raise ValueError(
            f"h(x) of {system.name!r} cannot be written into its observer, which then cannot compare y with h(x_hat), "
            "and holds the last value of an output that is missing: write h in arithmetic and the functions of "
            f"kkl_gym.elementary (sin, where, ...), without math, numpy and if ({error})"
        ) from error
    states = system.draw_starts(np.random.default_rng(0), 100)
    if not np.allclose(found(states), system.output(states), rtol=1e-9, atol=1e-12, equal_nan=True):
        raise ValueError(f"h(x) of {system.name!r} is another on symbols than on arrays: {values}")
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
