"""A single state's Runge–Kutta step as machine code, where Numba is installed: the same numbers in a tenth of the time.

The system's own functions f, g and rate are compiled as they stand, and put into the step that single states take.
Machine code adds and multiplies as Python does, in the same order, so that an episode is the same with it and without,
to the last bit. Powers are the exception: what ``**`` rounds to is left to the compiler. Equations with powers stay in
Python, and so do those that Numba cannot read.
"""

import dis
import functools
import logging
import math
import re
from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import numpy as np

from kkl_gym import elementary
from kkl_gym.simulate import GROWTH, MOST_EQUAL, PER_RATE, advance, runge_kutta
from kkl_gym.system import Components, System
from observers.observer import SOON

_EQUATIONS = ("f", "g", "rate")
_TRIALS = 1000  # states at which both are compared

Step = Callable[[Components, Components, Components, float], Components]
"""(x, u, w, dt) to the next x, as :func:`kkl_gym.simulate.advance` of a system."""

logger = logging.getLogger("kkl_gym")


@dataclass(frozen=True)
class SingleStep:
    """One sampling interval of a single state.

    Parameters
    ----------
    advance : callable
        From (x, u, w, dt) to the next x, as :func:`kkl_gym.simulate.advance` of the system.
    obstacle : str, optional
        Why Python takes the step; None where compiled code does.
    """

    advance: Step
    obstacle: str | None = None


def single_step(system: System) -> SingleStep:
    """One sampling interval of a single state: compiled if Numba is there and takes the equations, else in Python.

    The equations must depend on nothing but state, input, parameters, and numbers in attributes and in their module.
    Those are as they were when this was called. The logger ``kkl_gym`` says at level INFO, once for each system, if
    they are not compiled and why.

    Parameters
    ----------
    system : System
        Whose equations are taken.

    Returns
    -------
    SingleStep
        The step, and why it is not compiled where it is not.
    """
    read = tuple(tuple(sorted(_numbers_read(system, name).items())) for name in _EQUATIONS)
    return _shared_step(type(system), tuple(system.parameters.items()), read)  # type: ignore[arg-type]


@functools.lru_cache(maxsize=64)
def _shared_step(kind: type[System], parameters: tuple[tuple[str, float], ...], read: Any) -> SingleStep:
    system = kind(**dict(parameters))
    if system.discrete:
        return SingleStep(functools.partial(advance, system), f"{system.name} makes its step itself")
    try:
        return SingleStep(compiled_step(system))
    except Exception as error:  # anything may come out of Numba for a user's equations, which Python then takes
        obstacle = _reason(error)
        logger.info("single steps of %s stay in Python: %s", system.name, obstacle)
        return SingleStep(functools.partial(advance, system), obstacle)


def _reason(error: Exception) -> str:
    """What went wrong, in one line: Numba writes a page, in colours, of which a line says what it cannot take."""
    lines = re.sub(r"\x1b\[\d*m", "", str(error)).splitlines()
    said = [line for line in lines if line.strip() and not line.startswith("Failed in ")]
    return f"{type(error).__name__}: {said[0] if said else ''}"


def compiled_step(system: System) -> Step:
    """The compiled step of :func:`single_step`.

    Parameters
    ----------
    system : System
        Whose equations are taken.

    Returns
    -------
    callable
        From (x, u, w, dt) to the next x.

    Raises
    ------
    ImportError
        If Numba is not installed.
    ValueError
        If the equations hold powers, or the result is not what Python makes of them.
    Exception
        What Numba raises if it cannot take the equations.
    """
    import numba

    _teach_elementary()
    compiled: Any = functools.partial(numba.njit, error_model="numpy")  # a division by zero is infinite
    nx, nu = system.nx, system.nu
    constant = type(system).g is System.g
    namespace: dict[str, Any] = {"nan": math.nan}
    for name in ("f",) if constant else ("f", "g"):
        namespace[name] = compiled(_equations(system, name))
        namespace[f"{name}_self"] = _stand_in(system, name)
    if type(system).rate is System.rate:
        exec("\n".join(_rate_lines(system)), namespace)
    else:
        namespace["rate_of"], namespace["rate_self"] = compiled(type(system).rate), _stand_in(system, "rate")
        exec("def rate(x):\n    return rate_of(rate_self, x)", namespace)
    exec("\n".join(_field_lines(nx, nu, constant=constant)), namespace)
    namespace |= {name: compiled(namespace[name]) for name in ("field", "rate")}
    namespace["integrate"] = compiled(runge_kutta(nx if constant else nx + nu))
    exec("\n".join(_kernel_lines(system, constant=constant)), namespace)
    # Of floats alone: a bound of the input that is written as an integer must not compile it again.
    kernel = compiled((numba.float64,) * (nx + nu + nx + 1))(namespace["kernel"])

    def step(x: Components, u: Components, w: Components, dt: float) -> Components:
        try:
            end: Components = kernel(*x, *u, *w, dt)
        except Exception:  # Python says better what is wrong with the equations
            return advance(system, x, u, w, dt)
        return end if end[0] == end[0] else advance(system, x, u, w, dt)

    rng = np.random.default_rng(0)
    n, u_max, scale = _TRIALS // 2, np.array(system.u_max), np.array(system.scale) / system.pace
    low, high = np.array(system.bounds, dtype=float).T
    for x in np.concatenate([system.draw_starts(rng, n), rng.uniform(low, high, (n, nx))]):
        at = tuple(x.tolist()), (u_max * rng.uniform(-1, 1, nu)).tolist(), (scale * rng.uniform(-1, 1, nx)).tolist()
        if not np.array_equal(step(*at, system.dt), advance(system, *at, system.dt), equal_nan=True):
            raise ValueError(f"it rounds otherwise than Python at x = {list(at[0])}")
    return step


def _equations(system: System, name: str) -> Any:
    """A method's function, without powers; ValueError if it holds some."""
    function = getattr(type(system), name)
    if any("**" in instruction.argrepr for instruction in dis.get_instructions(function)):
        raise ValueError(f"{name} has a power; products, such as x * x for x**2, would be compiled")
    return function


def _stand_in(system: System, name: str) -> Any:
    """What a method finds on self, as far as these are numbers, in a type that Numba knows."""
    numbers = {key: value for key, value in _numbers_read(system, name).items() if hasattr(system, key)}
    return namedtuple("numbers", numbers)(**numbers)


def _numbers_read(system: System, name: str) -> dict[str, float]:
    """Numbers that a method may read beside its arguments, by their name: on self, or else in its module."""
    function = getattr(type(system), name)
    if not isinstance(function, FunctionType):
        return {}
    found = {key: getattr(system, key, function.__globals__.get(key)) for key in function.__code__.co_names}
    return {key: value for key, value in found.items() if isinstance(value, float | int)}


def _field_lines(nx: int, nu: int, *, constant: bool) -> list[str]:
    """Python of x' = f(x), or where g depends on the state f(x) + g(x) u, of x and u together: the input is held."""
    if constant:
        return ["def field(x):", "    return f(f_self, x)"]
    state, held = ("(" + "".join(f"x[{i}], " for i in these) + ")" for these in (range(nx), range(nx, nx + nu)))
    lines = ["def field(x):", f"    x, u = {state}, {held}", "    fx, gx = f(f_self, x), g(g_self, x)"]
    driven = [f"fx[{i}] + {_dot(f'gx[{i}]', nu)}" for i in range(nx)]
    return [*lines, f"    return {', '.join(driven + ['0.0'] * nu)},"]


def _dot(row: str, nu: int) -> str:
    """A row of the input matrix times u, added up as :func:`kkl_gym.simulate.forced` does."""
    return "(0.0" + "".join(f" + {row}[{j}] * u[{j}]" for j in range(nu)) + ")"


def _rate_lines(system: System) -> list[str]:
    """Python of the rate that :meth:`System.rate` finds numerically, written out."""
    steps = [5e-7 * (high - low) for low, high in system.X]
    lines = ["def rate(x):", "    fx, total = f(f_self, x), 0.0"]
    for j, step in enumerate(steps):
        moved = "".join(f"x[{i}] + {step!r}, " if i == j else f"x[{i}], " for i in range(system.nx))
        lines += [f"    fm, part = f(f_self, ({moved})), 0.0"]
        for i, unit in enumerate(steps):
            lines += [f"    part += ((fm[{i}] - fx[{i}]) / {unit!r}) ** 2"]
        lines += ["    total += part"]
    return [*lines, "    return total ** 0.5"]


def _kernel_lines(system: System, *, constant: bool) -> list[str]:
    """Python of the step: substeps of one length, NaN where these do not do."""
    nx, nu = system.nx, system.nu
    x, u, w = ([f"{letter}{i}" for i in range(n)] for letter, n in (("x", nx), ("u", nu), ("w", nx)))
    start, held, d = list(x), "".join(f"{ui}, " for ui in u), list(w)
    if not constant:
        start, d = [*x, *u], [*w, *["0.0"] * nu]
    elif nu == 1:
        d = [f"{float(gi)!r} * u0 + {wi}" for (gi,), wi in zip(system.G, w, strict=True)]
    elif nu:
        d = [f"{wi} + {_dot(f'({row!r})', nu)}" for row, wi in zip(system.G, w, strict=True)]
    return [
        f"def kernel({', '.join([*x, *u, *w, 'dt'])}):",
        *([f"    u = ({held})"] if nu else []),
        f"    need = rate(({', '.join(x)},)) * dt * {PER_RATE!r}",
        f"    if need <= {MOST_EQUAL}:",
        "        n = 1",
        "        while n < need:",
        "            n *= 2",
        f"        end = integrate(field, ({', '.join(start)},), ({', '.join(d)},), dt / n, n)",
        f"        x = ({''.join(f'end[{i}], ' for i in range(nx))})",
        f"        if rate(x) * dt * {PER_RATE!r} <= {GROWTH} * n:",
        "            return x",
        f"    return ({'nan, ' * nx})",
    ]


@functools.cache
def _teach_elementary() -> None:
    """Tell Numba what the functions of :mod:`kkl_gym.elementary` are on numbers."""
    import numba
    from numba.extending import overload

    def known(function: Callable[..., Any]) -> Callable[..., Any]:
        return numba.njit(function) if isinstance(function, FunctionType) else function

    def teach(function: Any) -> None:
        on_numbers = known(function.on_numbers)
        if function.__code__.co_argcount == 1:
            overload(function)(lambda x: lambda x: on_numbers(x))
        else:
            overload(function)(lambda a, b: lambda a, b: on_numbers(a, b))

    taught: dict[str, Any] = {name: each for name, each in vars(elementary).items() if hasattr(each, "on_numbers")}
    for function in taught.values():
        teach(function)
    minimum, maximum = known(taught["minimum"].on_numbers), known(taught["maximum"].on_numbers)
    overload(elementary.clip)(lambda x, low, high: lambda x, low, high: minimum(maximum(x, low), high))
    overload(elementary.where)(lambda condition, a, b: lambda condition, a, b: a if condition else b)


__all__ = ["SOON", "SingleStep", "Step", "compiled_step", "single_step"]
