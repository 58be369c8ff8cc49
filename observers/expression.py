"""Functions of state and input as data, so that a file can store f, g and h without executable code."""

import functools
import reprlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from observers.checks import is_finite

MOST_LEVELS = 24  # largest number of levels of nested functions
MOST_PARTS = 2000  # bound on numbers, states, inputs and functions, counted together in all components
_POWERS = 8  # integer exponents up to this absolute value compile to products
_MOST_NESTED = 16  # largest number of arguments that the source nests one by one; longer lists are combined in halves


class _Rule(NamedTuple):
    """A function that expressions can name: its Python source, and the types of its arguments and its result."""

    source: str
    takes: tuple[bool, ...]  # whether each argument is a condition
    more: bool = False  # whether more arguments like the last may follow
    gives: bool = False  # whether the result is a condition


_RULES: dict[str, _Rule] = {
    **{
        name: _Rule(f"np.{name}({{}})", (False,))
        for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "abs", "sign", "floor")
    },
    "+": _Rule("({} + {})", (False, False), more=True),
    "*": _Rule("({} * {})", (False, False), more=True),
    "**": _Rule("np.power({}, {})", (False, False)),
    "%": _Rule("np.mod({}, {})", (False, False)),
    "atan2": _Rule("np.arctan2({}, {})", (False, False)),
    "minimum": _Rule("np.minimum({}, {})", (False, False), more=True),
    "maximum": _Rule("np.maximum({}, {})", (False, False), more=True),
    "where": _Rule("np.where({}, {}, {})", (True, False, False)),
    **{name: _Rule(f"({{}} {name} {{}})", (False, False), gives=True) for name in ("<", "<=", ">", ">=")},
    "and": _Rule("np.logical_and({}, {})", (True, True), more=True, gives=True),
    "or": _Rule("np.logical_or({}, {})", (True, True), more=True, gives=True),
    "not": _Rule("np.logical_not({})", (True,), gives=True),
}


@dataclass(frozen=True)
class Expression:
    """A function of the state and the input, as nested lists that JSON can store.

    A component is a number, a state ``["x", index]``, an input ``["u", index]``, or a list of a name and its arguments,
    such as ``["*", 2.0, ["sin", ["x", 0]]]``. Names are arithmetic operators (``+``, ``*``, ``**``, ``%``), ``floor``,
    functions of ``kkl_gym.elementary`` except ``clip``, and, for the first argument of ``where``, comparisons and logic
    (``<``, ``<=``, ``>``, ``>=``, ``and``, ``or``, ``not``). Raises ValueError if a component has another form.

    Parameters
    ----------
    components : sequence
        The components, nested lists or tuples, of at most 24 nested functions and 2,000 parts.
    """

    components: Sequence[Any]
    _numpy: ClassVar[Any] = np

    def __post_init__(self) -> None:
        if not isinstance(self.components, list | tuple) or not self.components:
            raise ValueError(f"an expression must be a list of components, got {reprlib.repr(self.components)}")
        left = [MOST_PARTS]
        checked = tuple(_checked(part, False, MOST_LEVELS, left) for part in self.components)
        object.__setattr__(self, "components", checked)

    def __call__(self, x: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Evaluate the function. Shapes: ``x`` (..., nx), ``u`` (..., nu); returns (..., number of components)."""
        x = np.asarray(x, dtype=float)
        rows = [x[..., i] for i in range(self.states)]
        rows += [np.asarray(u, dtype=float)[..., j] for j in range(self.inputs)]
        out = np.empty((*x.shape[:-1], len(self.components)))
        with np.errstate(all="ignore"):
            for i, value in enumerate(self._function(*rows)):
                out[..., i] = value
        return out

    @functools.cached_property
    def _function(self) -> Callable[..., Any]:
        namespace: dict[str, Any] = {"np": self._numpy}
        exec(self.python("function", self.states, self.inputs), namespace)
        return namespace["function"]

    def __getstate__(self) -> dict[str, Any]:
        return {"components": self.components}  # compiled source cannot be pickled

    def python(self, name: str, nx: int, nu: int) -> str:
        """Return the source of a Python function that takes nx states and nu inputs and returns the components."""
        given = ", ".join([*(f"x{i}" for i in range(nx)), *(f"u{j}" for j in range(nu))])
        return f"def {name}({given}):\n    return ({''.join(_source(part) + ', ' for part in self.components)})"

    @property
    def operations(self) -> int:
        """Number of operations: the total number of arguments of all functions."""
        named = [part for each in self.components for part in _parts(each) if isinstance(part, tuple)]
        return sum(len(part) - 1 for part in named if part[0] not in ("x", "u"))

    @functools.cached_property
    def states(self) -> int:
        """Number of states that the function needs."""
        return self._count("x")

    @functools.cached_property
    def inputs(self) -> int:
        """Number of inputs that the function needs."""
        return self._count("u")

    def _count(self, letter: str) -> int:
        """Return one plus the largest index of the states, for the letter "x", or of the inputs, for "u"."""
        parts = (part for each in self.components for part in _parts(each))
        return max((int(part[1]) + 1 for part in parts if isinstance(part, tuple) and part[0] == letter), default=0)


def _checked(part: Any, condition: bool, levels: int, left: list[int]) -> Any:
    """Check a part of an expression and return it as numbers and tuples; ``left`` counts the parts still allowed."""
    left[0] -= 1
    if left[0] < 0 or levels < 0:
        raise ValueError(f"an expression has at most {MOST_PARTS} parts, and {MOST_LEVELS} nested functions")
    if is_finite(part) and not condition:
        return float(part)
    if not isinstance(part, list | tuple) or not part or not isinstance(part[0], str):
        raise ValueError(f"expected a {'' if condition else 'number or '}name and arguments, got {reprlib.repr(part)}")
    name, *arguments = part
    if name in ("x", "u") and not condition:
        if len(arguments) != 1 or type(arguments[0]) is not int or arguments[0] < 0:
            raise ValueError(f'a state is written as ["x", index], an input as ["u", index], got {reprlib.repr(part)}')
        return name, arguments[0]
    rule = _RULES.get(name)
    if rule is None or rule.gives != condition:
        known = [known for known in _RULES if _RULES[known].gives == condition]
        raise ValueError(f"{reprlib.repr(name)} must be one of these functions: {' '.join(known)}")
    if len(arguments) < len(rule.takes) or (len(arguments) > len(rule.takes) and not rule.more):
        raise ValueError(f"{name} takes {'at least ' * rule.more}{len(rule.takes)} arguments, got {len(arguments)}")
    kinds = (*rule.takes, *rule.takes[-1:] * (len(arguments) - len(rule.takes)))
    return name, *(_checked(each, kind, levels - 1, left) for each, kind in zip(arguments, kinds, strict=True))


def _source(part: Any) -> str:
    if isinstance(part, float):
        return f"({part!r})"
    name, *arguments = part
    if name in ("x", "u"):
        return f"{name}{arguments[0]}"
    sources = [_source(each) for each in arguments]
    if name == "**" and isinstance(exponent := arguments[1], float) and not isinstance(arguments[0], float):
        if exponent.is_integer() and abs(exponent) <= _POWERS:
            return f"({sources[0]} ** {int(exponent)})"
        if exponent == 0.5:
            return f"np.sqrt({sources[0]})"
    return _joined(_RULES[name].source, sources, len(_RULES[name].takes))


def _joined(source: str, sources: list[str], arity: int) -> str:
    """Return source that applies a function of ``arity`` arguments to all ``sources``; halving limits the nesting."""
    if len(sources) > _MOST_NESTED:
        half = len(sources) // 2
        sources = [_joined(source, sources[:half], arity), _joined(source, sources[half:], arity)]
    return functools.reduce(source.format, sources[arity:], source.format(*sources[:arity]))


def _parts(part: Any) -> Iterator[Any]:
    """Yield a part of an expression, and all parts inside it."""
    yield part
    if isinstance(part, tuple) and part[0] not in ("x", "u"):
        for each in part[1:]:
            yield from _parts(each)
