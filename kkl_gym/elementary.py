"""Elementary functions for equations of motion. They take every type of number.

Plain arithmetic and comparisons already work on Python floats, NumPy arrays, torch tensors and sympy expressions alike.
``math.sin``, ``np.sin`` and ``if`` do not. Equations import replacements from here::

    from kkl_gym.elementary import sin, where

Arguments may mix numbers with arrays, tensors or expressions. On floats, arrays and tensors exp(1000) is inf, log(0) is
-inf and sqrt(-1) is NaN, without a warning. ``docs/guides/your_system.md`` has a table of the functions.
"""

import builtins
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from kkl_gym.tracing import Symbol

_NUMBERS = (float, int, np.generic)
_NUMERIC = (np.ndarray, *_NUMBERS)
_SYMPY_NAMES = {"abs": "Abs", "maximum": "Max", "minimum": "Min"}


def _unary(name: str, on_numbers: Callable[[Any], Any], meaning: str) -> Callable[[Any], Any]:
    on_arrays = getattr(np, name)
    # In NumPy only these three warn at finite arguments. The others need no np.errstate, which takes time.
    if name in ("exp", "log", "sqrt"):
        on_arrays = np.errstate(all="ignore")(on_arrays)

    def function(x: Any) -> Any:
        if isinstance(x, _NUMBERS):
            try:
                return on_numbers(x)
            except (ValueError, OverflowError):  # raised by math for exp(1000), log(0) and sin(inf)
                with np.errstate(all="ignore"):
                    return float(on_arrays(float(x)))
        if isinstance(x, np.ndarray):
            return on_arrays(x)
        return _elsewhere(name, x)

    return _named(function, f"{name}(x)", meaning, on_numbers)


def _binary(name: str, on_numbers: Callable[[Any, Any], Any], meaning: str) -> Callable[[Any, Any], Any]:
    on_arrays = getattr(np, name)

    def function(a: Any, b: Any) -> Any:
        if isinstance(a, _NUMBERS) and isinstance(b, _NUMBERS):
            return on_numbers(a, b)
        if isinstance(a, _NUMERIC) and isinstance(b, _NUMERIC):
            return on_arrays(a, b)
        return _elsewhere(name, a, b)

    return _named(function, f"{name}(a, b)", meaning, on_numbers)


def _named(function: Any, call: str, meaning: str, on_numbers: Callable[..., Any]) -> Any:
    function.__name__ = function.__qualname__ = call.partition("(")[0]
    # kkl_gym.compiled compiles ``on_numbers``, which takes numbers only.
    function.on_numbers = on_numbers
    function.__doc__ = f"{call}, {meaning}, for floats, NumPy arrays, torch tensors and sympy expressions."
    return function


def _elsewhere(name: str, *args: Any) -> Any:
    """Record the call if an argument is a Symbol of kkl_gym.tracing, otherwise call the function of sympy or torch."""
    for arg in args:
        if isinstance(arg, Symbol):
            return arg.call(name, *args)
    if sympy := _library("sympy", "Basic", args):
        return getattr(sympy, _SYMPY_NAMES.get(name, name))(*args)
    if torch := _library("torch", "Tensor", args):
        return getattr(torch, name)(*_as_tensors(torch, args))
    wrong = ", ".join(type(arg).__name__ for arg in args)
    raise TypeError(f"{name} takes floats, arrays, torch tensors and sympy expressions, not {wrong}")


def _library(name: str, kind: str, args: tuple[Any, ...]) -> Any:
    """Return the library if an argument has its type ``kind``, else None; the library is never imported here."""
    library = sys.modules.get(name)
    return library if library is not None and any(isinstance(arg, getattr(library, kind)) for arg in args) else None


def _as_tensors(torch: Any, args: tuple[Any, ...]) -> list[Any]:
    """Return arguments as tensors; numbers take the dtype of the tensors among the arguments."""
    tensors = [arg for arg in args if isinstance(arg, torch.Tensor)]
    dtype = next((tensor.dtype for tensor in tensors if tensor.is_floating_point()), torch.float64)
    device = tensors[0].device
    return [arg if isinstance(arg, torch.Tensor) else torch.as_tensor(arg, dtype=dtype, device=device) for arg in args]


def _sign(x: Any) -> float:
    return 1.0 if x > 0 else -1.0 if x < 0 else 0.0 * x  # NaN for NaN


def _maximum(a: Any, b: Any) -> Any:
    return a if a >= b or a != a else b  # NaN if a or b is NaN, as in np.maximum


def _minimum(a: Any, b: Any) -> Any:
    return a if a <= b or a != a else b


sin = _unary("sin", math.sin, "the sine of an angle in rad")
cos = _unary("cos", math.cos, "the cosine of an angle in rad")
tan = _unary("tan", math.tan, "the tangent of an angle in rad")
exp = _unary("exp", math.exp, "e to the power of x")
log = _unary("log", math.log, "the natural logarithm")
sqrt = _unary("sqrt", math.sqrt, "the square root")
tanh = _unary("tanh", math.tanh, "the hyperbolic tangent")
abs = _unary("abs", builtins.abs, "the absolute value, like Python's abs")
sign = _unary("sign", _sign, "which is -1, 0 or 1")
atan2 = _binary("atan2", math.atan2, "the angle of the point (b, a) in rad")
minimum = _binary("minimum", _minimum, "the smaller of the two")
maximum = _binary("maximum", _maximum, "the larger of the two")


def clip(x: Any, low: Any, high: Any) -> Any:
    """clip(x, low, high), x limited to bounds, for floats, NumPy arrays, torch tensors and sympy expressions."""
    return minimum(maximum(x, low), high)


def where(condition: Any, a: Any, b: Any) -> Any:
    """Return ``a`` where the condition holds, else ``b``. This replaces ``if``, also for arrays and symbols.

    Parameters
    ----------
    condition : bool, or boolean array, tensor or sympy expression
        A comparison such as ``x[0] > 0``. Combine several by ``&`` and ``|``, each in parentheses. Do not negate by
        ``~``, which is bitwise on Python's True and False: write the opposite comparison.
    a, b : float, array, tensor or sympy expression
        Both are evaluated everywhere; infinite or NaN values that are not selected harm only torch's backward pass.

    Returns
    -------
    float, array, tensor or sympy expression
        The selected values, of the arguments' type.

    Raises
    ------
    TypeError
        If the condition is not a comparison.
    """
    if isinstance(condition, bool | np.bool_):
        return a if condition else b
    if isinstance(condition, np.ndarray) and condition.dtype == bool:
        return np.where(condition, a, b)
    if isinstance(condition, Symbol):
        return condition.call("where", condition, a, b)
    if sympy := _library("sympy", "Basic", (condition,)):
        return sympy.Piecewise((a, condition), (b, True))
    if (torch := _library("torch", "Tensor", (condition,))) and condition.dtype == torch.bool:
        return torch.where(*_as_tensors(torch, (condition, a, b)))
    raise TypeError(f"where takes a comparison such as x[0] > 0 as its condition, not {type(condition).__name__}")
