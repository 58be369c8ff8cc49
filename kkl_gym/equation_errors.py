"""Messages for errors in a user's equations: they name the system, the equation, its line and, where known, a fix."""

import inspect
import re
import reprlib
import sys
from collections.abc import Callable, Sequence
from numbers import Number, Real
from types import CodeType, TracebackType
from typing import Any

import numpy as np

from kkl_gym import elementary
from kkl_gym.tracing import Symbol
from kkl_gym.user_lines import line_of, path_of, steps_within, text_of

METHODS = ("f", "g", "h", "rate", "step", "reward", "terminated")
_TYPES = "floats, arrays, tensors and symbols"
# Functions of other modules that fail on some types of numbers, and their names in kkl_gym.elementary.
_FUNCTIONS = {name: name for name in vars(elementary) if not name.startswith("_")} | {
    "max": "maximum", "fmax": "maximum", "amax": "maximum", "Max": "maximum", "min": "minimum", "fmin": "minimum",
    "amin": "minimum", "Min": "minimum", "fabs": "abs", "absolute": "abs", "Abs": "abs", "arctan2": "atan2",
    "clamp": "clip",
}  # fmt: skip

Equations = Callable[..., Any]
"""A system's f, g, h, rate or step, or another function of the state's components."""


class EquationError(ValueError):
    """A user's equations failed, or returned an invalid value.

    The message names the system, the equation, its file and line and, where known, the argument and a fix. If the
    equations raised an exception, ``__cause__`` holds it.
    """


def failed(error: Exception, equations: Equations, *args: Any) -> EquationError:
    """Return the error for equations that raised an exception."""
    what, x = f"{type(error).__name__}: {error}", args[0]
    steps = steps_within(error, code_of(equations))
    if not steps:
        try:
            inspect.signature(equations).bind(*args)
        except TypeError:
            return EquationError(f"{_defined(equations)} must be defined as {signature(equations, 'self, ')}: {what}")
        return EquationError(f"{_defined(equations)} failed: {what}; {held(x)}")
    frame = steps[0].tb_frame
    local = frame.f_locals.get(next(iter(frame.f_code.co_varnames[1:2]), ""))
    if isinstance(local, tuple | list | np.ndarray) and len(local) == len(x):
        # Integration also calls the equations at states within a step: report the state at which they failed.
        x = local
    return EquationError(
        f"{label(equations)} failed in {line_of(steps[-1])}: {what}; {held(x)}{_hint(error, steps[-1], x)}"
    )


def returned(equations: Equations, wanted: str, found: str) -> EquationError:
    """Return the error for equations that returned an invalid value."""
    return EquationError(f"{_defined(equations)} must return {wanted}; it returned {found}")


def label(equations: Equations) -> str:
    """Return the name of equations, their arguments and their system as a text, such as ``f(x) of 'lorenz'``."""
    system = getattr(getattr(equations, "__self__", None), "name", None)
    return signature(equations) + ("" if system is None else f" of {system!r}")


def signature(equations: Equations, first: str = "") -> str:
    """Return name and arguments of equations as a text, such as ``f(x)``; ``first`` goes before the arguments."""
    return f"{name_of(equations)}({first}{'x, u' if name_of(equations) in ('step', 'reward') else 'x'})"


def name_of(equations: Equations) -> str:
    """Return the name of a method, even if its class assigns it from a function with another name."""
    function, kind = getattr(equations, "__func__", None), type(getattr(equations, "__self__", None))
    names = (name for name in METHODS if function and getattr(kind, name, None) is function)
    return next(names, getattr(equations, "__name__", "equations"))


def code_of(equations: Equations) -> CodeType | None:
    """Return the code of a function or method, or None if it is not written in Python."""
    return getattr(inspect.unwrap(getattr(equations, "__func__", equations)), "__code__", None)


def held(x: Any) -> str:
    """Return a text about the components of a state: their values, or their type and shape."""
    first = x[0]
    for library, kind, plural in (("torch", "Tensor", "tensors"), ("numpy", "ndarray", "arrays")):
        if is_of(library, kind, first):
            return f"x held {plural} of shape {tuple(first.shape)}"
    if is_of("sympy", "Basic", first) or isinstance(first, Symbol):
        return "x held symbols"
    shortened = [f"{value:.6g}" if isinstance(value, Number) else reprlib.repr(value) for value in x]
    return f"x = ({', '.join(shortened)})"


def shown(value: Any) -> str:
    """Return a value as text; for an array, only its shape, or its value if the shape is ()."""
    if isinstance(value, np.ndarray) or is_of("torch", "Tensor", value):
        return f"an array of shape {tuple(value.shape)}" if value.ndim else repr(value.item())
    return reprlib.repr(value)


def is_sequence(value: Any) -> bool:
    """Whether a value is a sequence of entries; an array of shape () is not."""
    if isinstance(value, np.ndarray) or is_of("torch", "Tensor", value):
        return bool(value.ndim)
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def is_of(library: str, kind: str, value: Any) -> bool:
    """Whether a value has a library's type ``kind``; the library is not imported for this check."""
    module = sys.modules.get(library)
    return module is not None and isinstance(value, getattr(module, kind))


def _defined(equations: Equations) -> str:
    code = code_of(equations)
    return label(equations) + ("" if code is None else f" ({path_of(code)}, line {code.co_firstlineno})")


def _hint(error: Exception, step: TracebackType, x: Any) -> str:
    on_floats = isinstance(x[0], Real)
    called = re.findall(r"(?:(?:math|cmath|np|numpy|torch|sympy)\.|(?<![\w.]))(\w+)\(", text_of(step))
    known = [_FUNCTIONS[name] for name in called if name in _FUNCTIONS]
    # If x is a tuple of floats, the hint helps if math.sqrt(-1) failed, but not if abs(x) got the tuple itself.
    if known and not (on_floats and isinstance(error, TypeError)):
        return f": use kkl_gym.elementary.{known[0]}, which takes {_TYPES}"
    if "truth value" in str(error) or "Boolean value" in str(error):
        return (
            ", on which `if`, `and`, `or` and `not` cannot decide: use kkl_gym.elementary.where, minimum, maximum "
            "or clip, and combine conditions by & and |"
        )
    if isinstance(error, IndexError) or "unpack" in str(error):
        return f": x has {len(x)} components"
    if not on_floats and not isinstance(error, NameError | KeyError | ArithmeticError):
        return f": write equations with arithmetic and the functions of kkl_gym.elementary, which take {_TYPES}"
    return ""
