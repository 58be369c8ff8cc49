"""Functions of state and input as data: a file can hold f, g and h, and nothing in it runs."""

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
    """A function of the state and the input, component by component, as JSON can hold it.

    A component is a number, a state ``["x", index]``, an input ``["u", index]``, or a list of a name and its arguments,
    such as ``["*", 2.0, ["sin", ["x", 0]]]``. The names are those of arithmetic (``+``, ``*``, ``**``, ``%``), of
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
            raise ValueError(f"an expression must be a list of components, got {reprlib.repr(self.components)}")
        left = [MOST_PARTS]
        checked = tuple(_checked(part, False, MOST_LEVELS, left) for part in self.components)
        object.__setattr__(self, "components", checked)

    def __call__(self, x: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Evaluate it. Shapes: ``x`` (..., nx), ``u`` (..., nu); returns (..., number of components)."""
        rows = {"x": np.moveaxis(np.asarray(x, dtype=float), -1, 0)}
        if u is not None:
            rows["u"] = np.moveaxis(np.asarray(u, dtype=float), -1, 0)
        out = np.empty((*rows["x"].shape[1:], len(self.components)))
        with np.errstate(all="ignore"):
            for i, part in enumerate(self.components):
                out[..., i] = _evaluated(part, rows)
        return out

    @property
    def states(self) -> int:
        """Number of states that it needs."""
        return max(_count(part, "x") for part in self.components)

    @property
    def inputs(self) -> int:
        """Number of inputs that it needs."""
        return max(_count(part, "u") for part in self.components)


def _checked(part: Any, condition: bool, levels: int, left: list[int]) -> Any:
    """A part of an expression as numbers and tuples; ``left`` holds how many parts more there may be."""
    left[0] -= 1
    if left[0] < 0 or levels < 0:
        raise ValueError(f"an expression has at most {MOST_PARTS} parts, on at most {MOST_LEVELS} levels")
    if is_finite(part) and not condition:
        return float(part)
    if not isinstance(part, list | tuple) or not part or not isinstance(part[0], str):
        raise ValueError(f"an expression is a finite number, or a name and its arguments, got {reprlib.repr(part)}")
    name, *arguments = part
    if name in ("x", "u") and not condition:
        if len(arguments) != 1 or type(arguments[0]) is not int or arguments[0] < 0:
            raise ValueError(f'a state is written as ["x", index], an input as ["u", index], got {reprlib.repr(part)}')
        return name, arguments[0]
    rule = _RULES.get(name)
    if rule is None or rule.gives != condition:
        known = [known for known in _RULES if _RULES[known].gives == condition]
        raise ValueError(f"{reprlib.repr(name)} is unknown where one of these is expected: {' '.join(known)}")
    if len(arguments) < len(rule.takes) or (len(arguments) > len(rule.takes) and not rule.more):
        raise ValueError(f"{name} takes {len(rule.takes)} arguments, got {len(arguments)}")
    kinds = (*rule.takes, *rule.takes[-1:] * (len(arguments) - len(rule.takes)))
    return name, *(_checked(each, kind, levels - 1, left) for each, kind in zip(arguments, kinds, strict=True))


def _evaluated(part: Any, rows: dict[str, np.ndarray]) -> Any:
    if isinstance(part, float):
        return np.float64(part)  # Python's own powers raise errors
    name, *arguments = part
    if name in ("x", "u"):
        return rows[name][arguments[0]]
    function, values = _RULES[name].function, [_evaluated(each, rows) for each in arguments]
    return functools.reduce(function, values) if len(values) > 1 and name != "where" else function(*values)


def _count(part: Any, letter: str) -> int:
    """One more than the largest index of a letter."""
    if isinstance(part, float):
        return 0
    if part[0] in ("x", "u"):
        return int(part[1]) + 1 if part[0] == letter else 0
    return max(_count(each, letter) for each in part[1:])


__all__ = ["Expression"]
