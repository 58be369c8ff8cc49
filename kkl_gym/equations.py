"""Calls of a user's equations, with checks of the values that they return.

Fast loops leave the checks out, and call :func:`blame` after an error.
"""

import math
from numbers import Real
from typing import Any

import numpy as np

from kkl_gym.equation_errors import (
    EquationError,
    Equations,
    code_of,
    failed,
    held,
    is_of,
    is_sequence,
    name_of,
    returned,
    shown,
    signature,
)
from kkl_gym.tracing import Symbol
from kkl_gym.user_lines import steps_within, user_line

_POWERS = "use kkl_gym.elementary.sqrt for square roots; take other fractional powers of abs(x)"


def components(equations: Equations, *args: Any) -> Any:
    """Call a system's f or h with x, or its step with x and u, and check the returned components."""
    values, x = _called(equations, *args), args[0]
    if name_of(equations) in ("f", "step"):
        n, wanted = len(x), f"{len(x)} components, one for each state"
    else:
        n, wanted = None, "its components in a sequence, as in (x[0],)"
    _check_components(equations, values, n, like=x[0], wanted=wanted)
    return values


def input_matrix(system: Any, x: Any) -> Any:
    """Call a system's g, and check the returned matrix. Shapes: ``x`` of length nx; returns (nx, nu)."""
    rows, nx, nu = _called(system.g, x), len(x), system.nu
    wanted = f"{nx} rows, one for each state, of {nu} components, one for each input"
    if not is_sequence(rows) or len(rows) != nx:
        raise returned(system.g, wanted, shown(rows))
    for i, row in enumerate(rows):
        _check_components(system.g, row, nu, like=x[0], wanted=wanted, where=f"in row [{i}] ")
    return rows


def rate_at(system: Any, x: Any) -> Any:
    """Call a system's rate, and check the returned number. Shapes: ``x`` of length nx."""
    return _number_at(system.rate, "one number in 1/s for each state x", x)


def check_task(system: Any, x: Any, u: Any) -> list[Any]:
    """Call a system's reward and terminated, and check the returned values. Shapes: ``x`` of length nx, ``u`` of nu."""
    wanted = "a bool or a comparison such as x[0] > 1 for each state x"
    ended = _number_at(system.terminated, wanted, x)
    if np.asarray(ended).dtype.kind != "b":
        raise returned(system.terminated, wanted, shown(ended))
    return [_number_at(system.reward, "one number for each state x", x, u), ended]


def _number_at(equations: Equations, wanted: str, *args: Any) -> Any:
    value, like = _called(equations, *args), args[0][0]
    if not _fits(value, like):
        raise returned(equations, wanted, _misfit(value, like))
    return value


def check_equations(system: Any) -> None:
    """Check the values of a system's equations at a few starts, one by one on floats and all at once on arrays."""
    names = ["step", "h", "rate"] if system.discrete else ["f", "h", "g", "rate"]
    names += ["reward", "terminated"] if system.states_task else []
    for name in names[:2]:
        if _is_default(getattr(system, name)):
            raise EquationError(f"{type(system).__name__} defines no {signature(getattr(system, name), 'self, ')}")
    starts = _checked_starts(system)
    for name in names:
        equations, n = getattr(system, name), len(starts)
        each = [_values(system, name, x, [0.0] * system.nu) for x in map(tuple, starts.tolist())]
        for value in each[0]:
            if isinstance(value, np.floating) and value.itemsize < 8:
                found = f"{value!r}, which makes the whole motion imprecise: write constants as Python's numbers"
                raise returned(equations, "floats of double precision", found)
        alone = np.array(each, dtype=float)
        wrong = ~np.isfinite(alone).all(1) | ((alone < 0).any(1) if name == "rate" else False)
        if wrong.any():
            at = int(wrong.argmax())
            wanted = "finite numbers at each start" + (", not below zero" if name == "rate" else "")
            raise returned(equations, wanted, f"{alone[at].tolist()}; {held(starts[at])}")
        x = starts.T.copy()
        u = np.zeros((system.nu, n))
        batch = np.array([np.broadcast_to(value, n) for value in _values(system, name, x, u)]).reshape(-1, n).T
        if u.any() or not np.array_equal(x, starts.T):
            given = "input" if u.any() else "state"
            found = f"something, but changed its argument, the {given}: write a = a + b in place of a += b"
            raise returned(equations, "a value and leave its arguments unchanged", found)
        rounding = 1e-6 * np.abs(alone).max(initial=0.0)
        differ = batch.shape != alone.shape or ~np.isclose(batch, alone, rtol=1e-3, atol=rounding).all(1)
        if np.any(differ):
            at = int(np.argmax(differ))
            wanted = "for each state of a batch the value that it returns for this state alone, at every call"
            found = f"{batch[at].tolist()} in a batch and {alone[at].tolist()} alone; {held(starts[at])}"
            fix = "sum, max and norm mix the states of a batch, so use arithmetic on components"
            raise returned(equations, wanted, f"{found}: {fix}")
    try:
        target_of(system)
    except EquationError as error:
        # If a user's target raises ValueError, there is no target. Only environments need one; they raise the error.
        if not isinstance(error.__cause__, ValueError):
            raise


def _values(system: Any, name: str, x: Any, u: Any) -> list[Any]:
    """Call the equation of this name, check the numbers that it returns, and return them as a list."""
    if name == "g":
        return [value for row in input_matrix(system, x) for value in row]
    if name == "rate":
        return [rate_at(system, x)]
    if name in ("reward", "terminated"):
        return [check_task(system, x, u)[name == "terminated"]]
    inputs = (u,) if name == "step" else ()
    return [*components(getattr(system, name), x, *inputs)]


def _checked_starts(system: Any) -> np.ndarray:
    """Draw a few starts, (n, nx), and check them."""
    n, low, high = 5, *np.array(system.bounds, dtype=float).T
    try:
        starts = np.asarray(system.draw_starts(np.random.default_rng(0), n))
    except Exception as error:  # a user's code may raise anything
        raise _unfinished(f"draw_starts(rng, n) of {system.name!r}", error) from error
    if starts.shape != (n, system.nx) or starts.dtype.kind not in "iuf":
        wanted = f"an array of numbers of shape (n, {system.nx})"
        raise EquationError(f"draw_starts(rng, {n}) of {system.name!r} must return {wanted}, got {shown(starts)}")
    if not ((starts >= low) & (starts <= high)).all():
        raise EquationError(f"draw_starts of {system.name!r} must stay within {system.bounds}, got {starts.tolist()}")
    return starts.astype(float)


def target_of(system: Any) -> Any:
    """Return a system's target after a check."""
    found, nx = f"target of {system.name!r}", system.nx
    try:
        target = system.target
    except Exception as error:  # a user's code may raise anything
        raise _unfinished(found, error) from error
    if callable(target):
        raise EquationError(f"{found} is a method: write @property above its def")
    if not is_sequence(target) or len(target) != nx or not all(_fits(t, 0.0) and math.isfinite(t) for t in target):
        raise EquationError(f"{found} must be {nx} finite numbers, one for each state, got {shown(target)}")
    return target


def _unfinished(what: str, error: Exception) -> EquationError:
    line = user_line(error)
    return EquationError(f"{what} failed{f' in {line}' if line else ''}: {type(error).__name__}: {error}")


def blame(error: Exception, system: Any, *args: Any) -> None:
    """Raise an EquationError if an exception comes from a system's equations of motion, otherwise return."""
    if isinstance(error, EquationError | NotImplementedError):
        return
    for equations in (system.step, system.f, system.g, system.rate):
        if not _is_default(equations) and steps_within(error, code_of(equations)):
            raise failed(error, equations, *args) from error
    # None of the equations raised the exception. If one of them returned an invalid value, its check raises here.
    with np.errstate(all="ignore"):
        if system.discrete:
            components(system.step, *args)
        else:
            components(system.f, args[0])
            input_matrix(system, args[0])
            rate_at(system, args[0])
    if isinstance(error, TypeError) and "complex" in str(error):  # complex numbers cannot be compared
        raise complex_motion(system, args[0]) from error


def complex_motion(system: Any, x: Any) -> EquationError:
    """Return the error for a motion that became complex, as ``x ** 0.5`` does for negative floats."""
    found = f"complex ones on the way from {held(x)}: {_POWERS}"
    return returned(system.step if system.discrete else system.f, "real numbers", found)


def _called(equations: Equations, *args: Any) -> Any:
    try:
        return equations(*args)
    except NotImplementedError:  # its message names the missing method
        raise
    except Exception as error:  # a user's code may raise anything
        raise failed(error, equations, *args) from error


def _is_default(equations: Equations) -> bool:
    return getattr(equations, "__module__", None) == "kkl_gym.system"


def _check_components(equations: Any, values: Any, n: int | None, *, like: Any, wanted: str, where: str = "") -> None:
    if not is_sequence(values):
        raise returned(equations, wanted, f"{where}{shown(values)}")
    if len(values) != n if n is not None else len(values) == 0:
        raise returned(equations, wanted, f"{where}{len(values)} of them: {shown(values)}")
    for i, value in enumerate(values):
        if not _fits(value, like):
            raise returned(equations, wanted, f"{where}{shown(values)}, whose entry [{i}] is {_misfit(value, like)}")


def _fits(value: Any, like: Any) -> bool:
    """Whether a value is a real number, or has the type of a component of the state and a shape that fits it."""
    if isinstance(value, Real | np.bool_):
        return True
    if is_of("torch", "Tensor", like):
        return is_of("torch", "Tensor", value) and not value.is_complex() and _broadcasts(value, like)
    if isinstance(like, Symbol):
        return isinstance(value, Symbol)
    if is_of("sympy", "Basic", like):
        return is_of("sympy", "Expr", value)
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and _broadcasts(value, like)


def _broadcasts(value: Any, like: Any) -> bool:
    shape = tuple(np.shape(like))
    try:
        return np.broadcast_shapes(tuple(value.shape), shape) == shape
    except ValueError:
        return False


def _misfit(value: Any, like: Any) -> str:
    dtype = getattr(value, "dtype", None)
    if isinstance(value, complex | np.complexfloating) or "complex" in str(dtype):
        return f"{shown(value)}, which is complex: {_POWERS}"
    if is_of("sympy", "Basic", value):
        return f"{value}, not a number: use kkl_gym.elementary.where({value}, 1.0, 0.0)"
    if dtype is not None and np.shape(like) != np.shape(value):
        return f"an array of shape {tuple(np.shape(value))}, where components of x have shape {tuple(np.shape(like))}"
    return f"{shown(value)}, of type {type(value).__name__}" + (
        ": equations also take symbols; use kkl_gym.elementary, not NumPy" if is_of("sympy", "Basic", like) else ""
    )
