"""Expressions as Python source, for Numba."""

from typing import Any

from observers.expression import Expression

MOST_OPERATIONS = 400  # beyond, such as for a network as f, compiling takes many seconds

_INFIX = {"+": " + ", "*": " * ", "<": " < ", "<=": " <= ", ">": " > ", ">=": " >= ", "and": " and ", "or": " or "}
_NUMPY = {"minimum", "maximum", "sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "sign", "floor"}
_CALLS = {name: f"np.{name}" for name in _NUMPY} | {"abs": "abs", "atan2": "np.arctan2", "%": "np.mod"}
_POWERS = 8  # up to which an exponent becomes products


def python_source(name: str, expression: Expression) -> str:
    """Write a function ``name(x, u, out)`` that fills ``out`` with the components; ValueError if it is too long."""
    if sum(map(_operations, expression.components)) > MOST_OPERATIONS:
        raise ValueError("the expression takes too long to compile")
    lines = [f"    out[{i}] = {_source(part)}" for i, part in enumerate(expression.components)]
    return "\n".join([f"def {name}(x, u, out):", *lines])


def _operations(part: Any) -> int:
    if isinstance(part, float) or part[0] in ("x", "u"):
        return 0
    return len(part) - 1 + sum(map(_operations, part[1:]))


def _source(part: Any) -> str:
    if isinstance(part, float):
        return f"({part!r})"
    name, *arguments = part
    if name in ("x", "u"):
        return f"{name}[{arguments[0]}]"
    sources = [_source(each) for each in arguments]
    if name == "**":
        exponent = arguments[1]
        if isinstance(exponent, float) and exponent.is_integer() and abs(exponent) <= _POWERS:
            return f"({sources[0]} ** {int(exponent)})"
        return "np.sqrt(" + sources[0] + ")" if exponent == 0.5 else f"({sources[0]} ** {sources[1]})"
    if name == "where":
        return f"({sources[1]} if {sources[0]} else {sources[2]})"
    if name == "not":
        return f"(not {sources[0]})"
    if name in _INFIX:
        return "(" + _INFIX[name].join(sources) + ")"
    text = f"{_CALLS[name]}({', '.join(sources[:2])})"
    for more in sources[2:]:  # of minimum and maximum
        text = f"{_CALLS[name]}({text}, {more})"
    return text


__all__ = ["python_source"]
