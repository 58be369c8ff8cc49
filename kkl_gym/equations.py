"""What goes wrong in the equations that a user writes, with file, line and the way out.

Equations are evaluated in many places, on floats, arrays, tensors and symbols. Where time does not matter they are
called through :func:`components`, :func:`input_matrix` and :func:`rate`, which look at what comes back. Where it does,
a loop catches what is raised and asks :func:`blame`.
"""

import inspect
import math
import reprlib
import sys
from collections.abc import Callable, Sequence
from numbers import Real
from types import CodeType, TracebackType
from typing import Any

import numpy as np

from kkl_gym import elementary
from kkl_gym.user_lines import called_function, line_of, path_of, steps_within, user_line

_SERVING = "floats, arrays, tensors and symbols"
_ALIASES = {
    alias: name
    for name, aliases in {
        "maximum": ("max", "fmax", "amax", "Max"),
        "minimum": ("min", "fmin", "amin", "Min"),
        "abs": ("fabs", "absolute", "Abs"),
        "atan2": ("arctan2",),
        "clip": ("clamp",),
    }.items()
    for alias in aliases
}


class EquationError(ValueError):
    """A user's equations failed, or returned what they must not.

    The message names the system, the equation, file and line, the argument and the way out. The exception that the
    equations raised, if they raised one, is the cause.
    """


def components(equations: Callable[[Any], Any], x: Any) -> Any:
    """Call a system's f or h, and check what comes back.

    Parameters
    ----------
    equations : callable
        A system's ``f`` or ``h``, or another function of the state's components.
    x : sequence of length nx
        Components of the state: floats, arrays, tensors or symbols.

    Returns
    -------
    sequence
        The components, untouched.

    Raises
    ------
    EquationError
        If it fails, or if what it returns is no sequence of numbers of the kind that ``x`` holds, nx of them
        from f.
    """
    values = _called(equations, x)
    if _name(equations) == "f":
        n, wanted = len(x), f"{len(x)} components, one for each state"
    else:
        n, wanted = None, "its components in a sequence, as in (x[0],)"
    _check_components(equations, values, n, like=x[0], wanted=wanted)
    return values


def input_matrix(system: Any, x: Any) -> Any:
    """Call a system's g, and check what comes back.

    Parameters
    ----------
    system : System
        The system.
    x : sequence of length nx
        As for :func:`components`.

    Returns
    -------
    sequence of sequences, shape (nx, nu)
        Its rows, untouched.

    Raises
    ------
    EquationError
        As :func:`components`, and if the shape is wrong.
    """
    rows, nx, nu = _called(system.g, x), len(x), system.nu
    wanted = f"{nx} rows, one for each state, of {nu} components, one for each input"
    if not _is_sequence(rows) or len(rows) != nx:
        raise _returned(system.g, wanted, _shown(rows))
    for row in rows:
        _check_components(system.g, row, nu, like=x[0], wanted=wanted)
    return rows


def rate(system: Any, x: Any) -> Any:
    """Call a system's rate, and check what comes back.

    Parameters
    ----------
    system : System
        The system.
    x : sequence of length nx
        As for :func:`components`.

    Returns
    -------
    float, array, tensor or symbol
        The rate in 1/s, untouched.

    Raises
    ------
    EquationError
        As :func:`components`.
    """
    value = _called(system.rate, x)
    if not _fits(value, x[0]):
        raise _returned(system.rate, "one number in 1/s for each state x", _misfit(value, x[0]))
    return value


def check_equations(system: Any, x: tuple[float, ...]) -> None:
    """Check all that a system's equations return on floats.

    Parameters
    ----------
    system : System
        A user's system.
    x : tuple of float, length nx
        A state in X.

    Raises
    ------
    EquationError
        If f or h is missing, an equation fails, or what it returns is wrong or not finite.
    """
    for equations in (system.f, system.h):
        if _is_default(equations):
            raise EquationError(f"{type(system).__name__} defines no {_name(equations)}(self, x)")
    for equations in (system.f, system.h):
        values = components(equations, x)
        if not all(math.isfinite(value) for value in values):
            raise EquationError(f"{_label(equations)}{_defined(equations)} returned {_shown(values)}; {_held(x)}, in X")
    input_matrix(system, x)
    if not 0 <= rate(system, x) < math.inf:
        raise _returned(system.rate, "a finite number in 1/s, not below zero", f"{rate(system, x)}; {_held(x)}")
    _check_target(system, len(x))


def _check_target(system: Any, nx: int) -> None:
    found = f"target of {system.name!r}"
    try:
        target = system.target
    except ValueError:  # there is none at these parameters; whoever needs one will say so
        return
    except Exception as error:  # whatever a user's code raises
        line = user_line(error)
        raise EquationError(
            f"{found} failed{f' in {line}' if line else ''}: {type(error).__name__}: {error}"
        ) from error
    if callable(target):
        raise EquationError(f"{found} is a method: write @property above its def")
    wanted = f"must be {nx} finite numbers, one for each state"
    if not _is_sequence(target) or len(target) != nx or not all(_fits(t, 0.0) and math.isfinite(t) for t in target):
        raise EquationError(f"{found} {wanted}, got {_shown(target)}")


def blame(error: Exception, system: Any, x: Any) -> None:
    """Raise an EquationError if an exception comes from a system's f, g or rate, and return otherwise.

    Parameters
    ----------
    error : Exception
        What was raised where they are evaluated in a loop.
    system : System
        The system.
    x : sequence of length nx
        Components of a state of the kind that the loop evaluates them on.

    Raises
    ------
    EquationError
        From the exception, or because the equations do not return what they must.
    """
    if isinstance(error, EquationError | NotImplementedError):
        return
    for equations in (system.f, system.g, system.rate):
        if not _is_default(equations) and steps_within(error, _code(equations)):
            raise _failure(error, equations, x) from error
    with np.errstate(all="ignore"):  # what they return then did not go through
        components(system.f, x)
        input_matrix(system, x)
        rate(system, x)


def _called(equations: Callable[[Any], Any], x: Any) -> Any:
    try:
        return equations(x)
    except NotImplementedError:  # says by itself what is missing
        raise
    except Exception as error:  # whatever a user's code raises
        raise _failure(error, equations, x) from error


def _failure(error: Exception, equations: Callable[[Any], Any], x: Any) -> EquationError:
    what = f"{type(error).__name__}: {error}"
    steps = steps_within(error, _code(equations))
    if not steps:
        try:
            inspect.signature(equations).bind(x)
        except TypeError:
            return EquationError(
                f"{_label(equations)}{_defined(equations)} cannot be called with x alone ({what}): "
                f"define {_name(equations)}(self, x)"
            )
        return EquationError(f"{_label(equations)}{_defined(equations)} failed: {what}; {_held(x)}")
    frame = steps[0].tb_frame
    local = frame.f_locals.get(next(iter(frame.f_code.co_varnames[1:2]), ""))
    if isinstance(local, type(x)) and len(local) == len(x):
        x = local  # where it failed, which need not be the start of a step
    place, hint = line_of(steps[-1]), _hint(error, steps[-1], x)
    return EquationError(f"{_label(equations)} failed in {place}: {what}; {_held(x)}{hint}")


def _hint(error: Exception, step: TracebackType, x: Any) -> str:
    name = called_function(step)
    name = _ALIASES.get(name, name)
    if name in vars(elementary) and not name.startswith("_"):
        return f": use kkl_gym.elementary.{name}, which serves {_SERVING}"
    if "truth value" in str(error) or "Boolean value" in str(error):
        return (
            ", on which `if`, `and`, `or` and `not` cannot decide: use kkl_gym.elementary.where, minimum, maximum "
            "or clip, and combine conditions by & and |"
        )
    if isinstance(error, IndexError) or "unpack" in str(error):
        return f", {len(x)} of them"
    if not isinstance(x[0], Real) and not isinstance(error, NameError | KeyError | ArithmeticError):
        return f": equations take arithmetic and the functions of kkl_gym.elementary, which serve {_SERVING}"
    return ""


def _check_components(equations: Any, values: Any, n: int | None, *, like: Any, wanted: str) -> None:
    if not _is_sequence(values):
        raise _returned(equations, wanted, _shown(values))
    if len(values) != n if n is not None else len(values) == 0:
        raise _returned(equations, wanted, f"{len(values)} of them: {_shown(values)}")
    for i, value in enumerate(values):
        if not _fits(value, like):
            raise _returned(equations, wanted, f"{_shown(values)}, of which [{i}] is {_misfit(value, like)}")


def _is_sequence(values: Any) -> bool:
    # An array of shape () has no length.
    return (isinstance(values, Sequence) and not isinstance(values, str | bytes)) or (
        (isinstance(values, np.ndarray) or _is_of("torch", "Tensor", values)) and values.ndim > 0
    )


def _fits(value: Any, like: Any) -> bool:
    """Whether a value is a number, or of the kind of a component of the state."""
    if isinstance(value, Real | np.bool_):
        return True
    if _is_of("torch", "Tensor", like):
        return _is_of("torch", "Tensor", value) and not value.is_complex() and _broadcasts(value, like)
    if _is_of("sympy", "Basic", like):
        return _is_of("sympy", "Expr", value)
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
        return f"{_shown(value)}, which is complex: use kkl_gym.elementary.sqrt or abs for powers of negative numbers"
    if _is_of("sympy", "Basic", value):
        return f"{value}, which is no number: use kkl_gym.elementary.where({value}, 1.0, 0.0)"
    if dtype is not None and np.shape(like) != np.shape(value):
        return f"of shape {tuple(np.shape(value))}, where the components of x have shape {tuple(np.shape(like))}"
    return f"{_shown(value)}, of type {type(value).__name__}"


def _returned(equations: Any, wanted: str, found: str) -> EquationError:
    return EquationError(f"{_label(equations)}{_defined(equations)} must return {wanted}; it returned {found}")


def _label(equations: Any) -> str:
    system = getattr(getattr(equations, "__self__", None), "name", None)
    return f"{_name(equations)}(x)" + ("" if system is None else f" of {system!r}")


def _name(equations: Any) -> str:
    """The name of a method, which may have been assigned from a function of another name."""
    function, kind = getattr(equations, "__func__", None), type(getattr(equations, "__self__", None))
    names = (name for name in ("f", "g", "h", "rate") if function and getattr(kind, name, None) is function)
    return next(names, getattr(equations, "__name__", "equations"))


def _is_default(equations: Any) -> bool:
    return getattr(equations, "__module__", None) == "kkl_gym.system"


def _code(equations: Any) -> CodeType | None:
    return getattr(inspect.unwrap(getattr(equations, "__func__", equations)), "__code__", None)


def _defined(equations: Any) -> str:
    code = _code(equations)
    return "" if code is None else f" ({path_of(code)}, line {code.co_firstlineno})"


def _held(x: Any) -> str:
    first = x[0]
    for library, kind, plural in (("torch", "Tensor", "tensors"), ("numpy", "ndarray", "arrays")):
        if _is_of(library, kind, first):
            return f"x held {plural} of shape {tuple(first.shape)}"
    if _is_of("sympy", "Basic", first):
        return "x held sympy symbols"
    return f"x = {reprlib.repr(tuple(float(f'{value:.6g}') for value in x))}"


def _shown(value: Any) -> str:
    if isinstance(value, np.ndarray) or _is_of("torch", "Tensor", value):
        return f"an array of shape {tuple(value.shape)}" if value.ndim else repr(value.item())
    return reprlib.repr(value)


def _is_of(library: str, kind: str, value: Any) -> bool:
    """Whether a value is of a library's type, which then has been imported already."""
    module = sys.modules.get(library)
    return module is not None and isinstance(value, getattr(module, kind))
