"""Records equations as a program: a list of operations in the order in which Python runs them."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

_ARITHMETIC = {"add": "+", "sub": "-", "mul": "*", "truediv": "/", "mod": "%"}
_COMPARISONS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!=", "and": "&", "or": "|"}


class Tape:
    """The operations recorded so far; ``exact`` means that machine code rounds each of them as Python does."""

    def __init__(self) -> None:
        self.names: dict[str, str] = {}  # names of results, by operation
        self.exact = True

    def write(self, operation: str, *, exact: bool = True) -> "Symbol":
        """Record an operation, and return its result; a repeated operation is recorded once."""
        self.exact &= exact
        return Symbol(self, self.names.setdefault(operation, f"t{len(self.names)}"))


class Symbol:
    """A number without a value. Arithmetic on it is recorded on its tape."""

    # NumPy's numbers leave arithmetic with a Symbol to the operators below.
    __array_ufunc__ = None
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, tape: Tape, name: str) -> None:
        self.tape, self.name = tape, name

    def call(self, function: str, *args: Any) -> "Symbol":
        """Record the call of a function of :mod:`kkl_gym.elementary`."""
        return self.tape.write(f"{function}({', '.join(map(text, args))})")

    def __neg__(self) -> "Symbol":
        return self.tape.write(f"-{self.name}")

    def __pos__(self) -> "Symbol":
        return self

    def __abs__(self) -> "Symbol":
        return self.call("abs", self)

    def __pow__(self, power: Any) -> Any:
        n = float(power) if isinstance(power, Real) else math.nan
        if n == 0.5:
            return self.tape.write(f"sqrt({self.name})", exact=False)
        if n.is_integer() and n:
            whole = self.tape.write(f"{self.name} ** {abs(int(n))}", exact=False)
            return whole if n > 0 else self.tape.write(f"1.0 / {whole.name}", exact=False)
        return self.tape.write(f"{self.name} ** {text(power)}", exact=False)

    def __rpow__(self, base: Any) -> "Symbol":
        return self.tape.write(f"{text(base)} ** {self.name}", exact=False)

    def __bool__(self) -> bool:
        raise TypeError("the truth value of a symbol is not known")


def _operator(sign: str, *, reflected: bool = False) -> Callable[[Symbol, Any], Symbol]:
    def write(self: Symbol, other: Any) -> Symbol:
        pair = (text(other), self.name) if reflected else (self.name, text(other))
        return self.tape.write(f" {sign} ".join(pair), exact=sign != "%")

    return write


for _name, _sign in {**_ARITHMETIC, **_COMPARISONS}.items():
    setattr(Symbol, f"__{_name}__", _operator(_sign))
for _name in ("add", "sub", "mul", "truediv", "mod", "and", "or"):
    setattr(Symbol, f"__r{_name}__", _operator({**_ARITHMETIC, **_COMPARISONS}[_name], reflected=True))


def text(value: Any) -> str:
    """Return the text of a symbol or a number in a program."""
    if isinstance(value, Symbol):
        return value.name
    if isinstance(value, bool | np.bool_):
        return str(bool(value))
    if not isinstance(value, Real):
        raise TypeError(f"equations take numbers and symbols, not {type(value).__name__}")
    number = float(value)
    return f"({number!r})" if math.copysign(1.0, number) < 0 else repr(number)


@dataclass(frozen=True)
class Program:
    """A function as a list of operations on named arguments; ``exact`` as for :class:`Tape`."""

    arguments: tuple[str, ...]
    operations: tuple[str, ...]
    results: tuple[str, ...]
    exact: bool

    def lines(self, name: str, zeros: int = 0) -> list[str]:
        """Return Python code of the function, from a tuple of arguments to a tuple of results and ``zeros`` zeros."""
        return [
            f"def {name}(values):",
            f"    {in_tuple(self.arguments)} = values",
            *[f"    {operation}" for operation in self.operations],
            f"    return {in_tuple([*self.results, *['0.0'] * zeros])}",
        ]


def in_tuple(values: Iterable[str]) -> str:
    """Return Python code of a tuple."""
    return "(" + "".join(f"{value}, " for value in values) + ")"


def program(function: Callable[..., Any], *letters: tuple[str, int]) -> Program:
    """Record a call of a function with lists of symbols; ``letters`` holds a letter and a length for each list."""
    tape = Tape()
    groups = [[Symbol(tape, f"{letter}{i}") for i in range(n)] for letter, n in letters]
    results = tuple(map(text, function(*groups)))
    operations = tuple(f"{name} = {operation}" for operation, name in tape.names.items())
    return Program(tuple(each.name for group in groups for each in group), operations, results, tape.exact)
