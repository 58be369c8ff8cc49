"""Outputs h(x) as data: what a file says of them can be evaluated, and nothing in it runs."""

import functools
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from observers.checks import is_finite

MOST_LEVELS = 24  # of expressions within one another
MOST_PARTS = 2000  # of all components together: numbers, states and functions


class _Rule(NamedTuple):
    """What a name stands for: a function of numbers or conditions, which gives one of these."""

    function: Callable[..., Any]
    takes: tuple[bool, ...]  # for each argument, whether it is a condition
    more: bool = False  # whether it goes on with any number of arguments like the last
    gives: bool = False  # whether it is a condition itself


_RULES: dict[str, _Rule] = {
    **{
        name: _Rule(getattr(np, name), (False,))
        for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "abs", "sign", "floor")
    },
    "+": _Rule(np.add, (False, False), more=True),
    "*": _Rule(np.multiply, (False, False), more=True),
    "**": _Rule(np.power, (False, False)),
    "%": _Rule(np.mod, (False, False)),
    "atan2": _Rule(np.arctan2, (False, False)),
    "minimum": _Rule(np.minimum, (False, False), more=True),
    "maximum": _Rule(np.maximum, (False, False), more=True),
    "where": _Rule(np.where, (True, False, False)),
    "<": _Rule(np.less, (False, False), gives=True),
    "<=": _Rule(np.less_equal, (False, False), gives=True),
    ">": _Rule(np.greater, (False, False), gives=True),
    ">=": _Rule(np.greater_equal, (False, False), gives=True),
    "and": _Rule(np.logical_and, (True, True), more=True, gives=True),
    "or": _Rule(np.logical_or, (True, True), more=True, gives=True),
    "not": _Rule(np.logical_not, (True,), gives=True),
}


@dataclass(frozen=True)
class Expression:
    """A function of the state, component by component, as JSON can hold it.

    A component is a number, a state ``["x", index]``, or a list of a name and its arguments, such as
    ``["*", 2.0, ["sin", ["x", 0]]]``. The names are those of arithmetic (``+``, ``*``, ``**``, ``%``), of
    ``kkl_gym.elementary`` and of comparisons (``<``, ``<=``, ``>``, ``>=``, ``and``, ``or``, ``not``), which ``where``
    takes as its first argument.

    Parameters
    ----------
    components : sequence
        The components, nested lists or tuples.

    Raises
    ------
    ValueError
        If a component is no expression, a name is unknown, or there are more than 24 levels or 2,000 parts.
    """

    components: Sequence[Any]

    def __post_init__(self) -> None:
        if not isinstance(self.components, list | tuple) or not self.components:
            raise ValueError(f"an output h(x) must be a list of components, got {reprlib.repr(self.components)}")
        left = [MOST_PARTS]
        checked = tuple(_checked(part, False, MOST_LEVELS, left) for part in self.components)
        object.__setattr__(self, "components", checked)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Evaluate it. Shapes: ``x`` (..., nx); returns (..., number of components)."""
        rows = np.moveaxis(np.asarray(x, dtype=float), -1, 0)
        with np.errstate(all="ignore"):
            values = [_evaluated(part, rows) for part in self.components]
        return np.stack([np.broadcast_to(value, rows.shape[1:]) for value in values], axis=-1)

    @property
    def states(self) -> int:
        """Number of states that it asks for."""
        return max(map(_states, self.components))


def _checked(part: Any, condition: bool, levels: int, left: list[int]) -> Any:
    """A part of an expression as numbers and tuples; ``left`` holds how many parts more there may be."""
    left[0] -= 1
    if left[0] < 0 or levels < 0:
        raise ValueError(f"an output h(x) has at most {MOST_PARTS} parts, on at most {MOST_LEVELS} levels")
    if is_finite(part) and not condition:
        return float(part)
    if not isinstance(part, list | tuple) or not part or not isinstance(part[0], str):
        raise ValueError(f"an expression is a finite number, or a name and its arguments, got {reprlib.repr(part)}")
    name, *arguments = part
    if name == "x" and not condition:
        if len(arguments) != 1 or type(arguments[0]) is not int or arguments[0] < 0:
            raise ValueError(f'a state is written as ["x", index], got {reprlib.repr(part)}')
        return name, arguments[0]
    rule = _RULES.get(name)
    if rule is None or rule.gives != condition:
        known = [known for known in _RULES if _RULES[known].gives == condition]
        raise ValueError(f"{reprlib.repr(name)} is unknown where one of these is expected: {' '.join(known)}")
    if len(arguments) < len(rule.takes) or (len(arguments) > len(rule.takes) and not rule.more):
        raise ValueError(f"{name} takes {len(rule.takes)} arguments, got {len(arguments)}")
    kinds = (*rule.takes, *rule.takes[-1:] * (len(arguments) - len(rule.takes)))
    return name, *(_checked(each, kind, levels - 1, left) for each, kind in zip(arguments, kinds, strict=True))


def _evaluated(part: Any, x: np.ndarray) -> Any:
    if isinstance(part, float):
        return np.float64(part)  # Python's own powers raise errors
    name, *arguments = part
    if name == "x":
        return x[arguments[0]]
    function, values = _RULES[name].function, [_evaluated(each, x) for each in arguments]
    return functools.reduce(function, values) if len(values) > 1 and name != "where" else function(*values)


def _states(part: Any) -> int:
    if isinstance(part, float):
        return 0
    return int(part[1]) + 1 if part[0] == "x" else max(map(_states, part[1:]))


__all__ = ["Expression"]
