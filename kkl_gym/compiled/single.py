"""A single state's Runge–Kutta step as machine code, where Numba is installed: the same numbers in a tenth of the time.

The system's own functions f, g and rate are compiled as they stand, and put into the step that single states take.
Machine code adds and multiplies as Python does, in the same order, so that an episode is the same with it and without,
to the last bit. That holds of +, -, * and /, of comparisons and of :mod:`kkl_gym.elementary`. Equations with anything
else, such as powers and NumPy's functions, which compilers round in their own ways, stay in Python.
"""

import dis
import functools
import math
import warnings
from collections.abc import Callable
from types import CodeType, FunctionType
from typing import Any

import numpy as np

from kkl_gym import elementary
from kkl_gym.compiled.reading import Read
from kkl_gym.compiled.step import Advance, SamplingStep, shared_step, trial_states
from kkl_gym.simulate import ATTEMPTS, MOST_EQUAL, PER_RATE, advance, per_tolerance, runge_kutta
from kkl_gym.system import Components, System, rate_under

_TRIALS = 200  # states of each kind at which both are compared
_MOST_SUBSTEPS = 64  # of a state that is compared: Python would take long for more
_MOST_INSTRUCTIONS = 600  # of Python's, in f, g and rate each; beyond, compiling takes many seconds
_OPERATORS = ("+", "-", "*", "/", "&", "|")


def single_step(system: System) -> SamplingStep[Components]:
    """One sampling interval of a single state: compiled if Numba is there and takes the equations, else in Python.

    The equations must depend on nothing but state, input, parameters, and numbers in attributes and in their module.
    Those are as they were when this was called. The logger ``kkl_gym`` says at level INFO, once for each system, if
    they are not compiled and why.
    """
    said = f"single steps of {system.name} stay in Python"
    return shared_step(system, compiled_step, advance, said=said)


def compiled_step(system: System) -> Advance[Components]:
    """The compiled step of :func:`single_step`."""
    import numba

    _teach_elementary()
    compiled: Any = functools.partial(numba.njit, error_model="python")  # which raises where Python does
    nx, nu = system.nx, system.nu
    constant = type(system).g is System.g
    namespace: dict[str, Any] = {"nan": math.nan}
    for name in ("f",) if constant else ("f", "g"):
        function = getattr(type(system), name)
        namespace[name], namespace[f"{name}_self"] = compiled(function), _checked(system, name).stand_in()
    if rated := type(system).rate is not System.rate:
        namespace["rate"], namespace["rate_self"] = compiled(type(system).rate), _checked(system, "rate").stand_in()
    exec("\n".join(_field_lines(nx, nu, constant=constant)), namespace)
    namespace["field"] = compiled(namespace["field"])
    namespace["integrate"] = compiled(runge_kutta(nx if constant else nx + nu))
    exec("\n".join(_kernel_lines(system, constant=constant, rated=rated)), namespace)
    # Of floats alone: a bound of the input that is written as an integer must not compile it again.
    kernel = compiled((numba.float64,) * (nx + nu + nx + 1))(namespace["kernel"])

    def step(x: Components, u: Components, w: Components, dt: float) -> Components:
        try:
            end: Components = kernel(*x, *u, *w, dt)
        except Exception:  # Python says better what is wrong with the equations
            return advance(system, x, u, w, dt)
        return end if end[0] == end[0] else advance(system, x, u, w, dt)

    rng = np.random.default_rng(0)
    u_max, scale = np.array(system.u_max), np.array(system.scale) / system.pace
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for x in map(tuple, np.concatenate(trial_states(system, _TRIALS, rng)).tolist()):
            u, w = (u_max * rng.uniform(-1, 1, nu)).tolist(), (scale * rng.uniform(-1, 1, nx)).tolist()
            try:
                if not rate_under(system, x, u) * system.dt * PER_RATE <= _MOST_SUBSTEPS:
                    continue
                end = kernel(*x, *u, *w, system.dt)
            except Exception:  # Python takes the step
                continue
            if end[0] == end[0] and tuple(end) != tuple(advance(system, x, u, w, system.dt)):
                raise ValueError(f"it rounds otherwise than Python at x = {list(x)}")
    return step


def _checked(system: System, name: str) -> Read:
    """What a method reads; ValueError if it does what Numba might not do to the last bit, or is long.

    The rate says how many substeps there are, so that its last bit does not matter.
    """
    function: Any = getattr(type(system), name)
    if not isinstance(function, FunctionType):
        raise ValueError(f"{name} is no plain method")
    code, exact = function.__code__, name != "rate"
    instructions = list(dis.get_instructions(function))
    if len(instructions) > _MOST_INSTRUCTIONS:
        raise ValueError(f"{name} is too long to compile in seconds")
    if code.co_freevars or code.co_cellvars or any(isinstance(each, CodeType) for each in code.co_consts):
        raise ValueError(f"{name} makes functions, or is made by one")
    for instruction in instructions:
        if instruction.opname == "BINARY_OP":
            operator = instruction.argrepr.rstrip("=")
            if operator == "**" and exact:
                raise ValueError(f"{name} has a power; products, such as x * x for x**2, would be compiled")
            if operator not in _OPERATORS and operator != "**":
                raise ValueError(f"{name} has the operator {operator}")
        elif instruction.opname == "STORE_GLOBAL":
            raise ValueError(f"{name} writes to its module")
    read = Read(system, function)
    known: list[Any] = [each for each in vars(elementary).values() if isinstance(each, FunctionType)]
    known += [elementary, abs] if exact else [elementary, abs, max, min, math]
    for other, value in read.others.items():
        if not any(value is each for each in known):
            raise ValueError(f"{name} uses {other}, which is neither a number nor of kkl_gym.elementary")
    homes = [value for value in read.others.values() if value in (elementary, math)]
    for attribute in read.attributes:
        if not any(hasattr(home, attribute) for home in homes):
            raise ValueError(f"{name} reads {attribute}, which is no plain number of the system")
    return read


def _field_lines(nx: int, nu: int, *, constant: bool) -> list[str]:
    """Python of x' = f(x), or where g depends on the state f(x) + g(x) u, of x and u together: the input is held."""
    if constant:
        return ["def field(x):", "    return f(f_self, x)"]
    state, held = ("(" + "".join(f"x[{i}], " for i in these) + ")" for these in (range(nx), range(nx, nx + nu)))
    field = ["def field(x):", f"    x, u = {state}, {held}", "    fx, gx = f(f_self, x), g(g_self, x)"]
    return [*field, "    return " + "".join(f"fx[{i}] + {_dot(f'gx[{i}]', nu)}, " for i in range(nx)) + "0.0, " * nu]


def _dot(row: str, nu: int) -> str:
    """A row of the input matrix times u, added up as :func:`kkl_gym.system.dot` does."""
    return "(0.0" + "".join(f" + {row}[{j}] * u[{j}]" for j in range(nu)) + ")"


def _kernel_lines(system: System, *, constant: bool, rated: bool) -> list[str]:
    """Python of the step: substeps of one length, NaN where these do not do."""
    nx, nu = system.nx, system.nu
    x, u, w = ([f"{letter}{i}" for i in range(n)] for letter, n in (("x", nx), ("u", nu), ("w", nx)))
    start, d, units = list(x), list(w), per_tolerance(type(system))
    if not constant:
        start, d, units = [*x, *u], [*w, *["0.0"] * nu], units + (0.0,) * nu
    elif nu == 1:
        d = [f"{float(gi)!r} * u0 + {wi}" for (gi,), wi in zip(system.G, w, strict=True)]
    elif nu:
        d = [f"{wi} + {_dot(f'({row!r})', nu)}" for row, wi in zip(system.G, w, strict=True)]
    need = f"rate(rate_self, ({', '.join(x)},)) * dt * {PER_RATE!r}" if rated else "1.0"
    return [
        f"def kernel({', '.join([*x, *u, *w, 'dt'])}):",
        f"    u, need = ({''.join(f'{ui}, ' for ui in u)}), {need}",
        f"    for attempt in range({ATTEMPTS}):",
        f"        if not need <= {MOST_EQUAL}:",
        "            break",
        "        n = 1",
        "        while n < need:",
        "            n *= 2",
        f"        end, error = integrate(field, ({', '.join(start)},), ({', '.join(d)},), dt / n, n, {units!r})",
        "        if error <= 1.0:",
        f"            return ({''.join(f'end[{i}], ' for i in range(nx))})",
        "        need = n * error**0.1",
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
