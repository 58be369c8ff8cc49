"""Machine code for the step over a sampling interval, if Numba is installed and can compile a system's equations.

The equations run on symbols, which record them as a program (:mod:`kkl_gym.tracing`). Numba compiles this program
together with the Runge–Kutta step, in about a second. The compiled step of a single state equals the step in Python to
the last bit and takes a tenth of its time. Compilers round powers and remainders in their own way, so equations with
these are compiled only for batches.
"""

import functools
import logging
import math
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType
from typing import Any, Generic, TypeVar

import numpy as np

from kkl_gym import elementary
from kkl_gym.equations import blame, rate_at
from kkl_gym.simulate import (
    ATTEMPTS,
    MOST_EQUAL,
    PER_RATE,
    advance,
    advance_batch,
    equal_substeps,
    forced,
    per_tolerance,
    runge_kutta,
)
from kkl_gym.system import Components, System, rate_under
from kkl_gym.tracing import Program, in_tuple, program

Values = TypeVar("Values")
Advance = Callable[[Values, Values, Values, float], Values]
"""Maps (x, u, w, dt) to the next x."""

# Longer programs, such as a neural network for f, would take many seconds to compile.
MAX_OPERATIONS = 500
_TRIALS = 200  # number of trial states of each kind, at which machine code is compared with Python
_MAX_TRIAL_SUBSTEPS = 64  # trial states that need more substeps are skipped, because Python is slow there
_LANES = 32  # number of a batch's states that are stepped together; they fill a few of the processor's vector registers
# Largest number of entries in the cache. An entry is a kernel, or the reason why a program was not compiled.
_KEPT = 64
_kept: dict[Any, Any] = {}

logger = logging.getLogger("kkl_gym")


@dataclass(frozen=True)
class SamplingStep(Generic[Values]):
    """The step over one sampling interval; ``obstacle`` is the reason why it is not compiled, None if it is."""

    advance: Advance[Values]
    obstacle: str | None = None

    def __call__(self, x: Values, u: Values, w: Values, dt: float) -> Values:
        """Return the next state. Values are sequences of floats, or for a batch arrays (nx, n) and (nu, n)."""
        return self.advance(x, u, w, dt)


@dataclass(frozen=True)
class Motion:
    """Programs of x' = field(x) + push(u, w) if g is constant, else of x' = field(x, u) + push(u, w) with push = w.

    ``rate`` is the program of :meth:`System.rate`, which limits substeps; None if the system does not override it.
    """

    field: Program
    push: Program
    rate: Program | None
    units: tuple[float, ...]  # 1 / tolerance of each state, then a 0 for each input that the field depends on


def single_step(system: System) -> SamplingStep[Components]:
    """Return the step of a single state, compiled if Numba is installed and can compile the equations, else in Python.

    A compiled step keeps the values that globals and other numbers in the equations had when it was compiled.
    """
    return _shared(system, single_kernel, _single, advance, f"single steps of {system.name} stay in Python")


def batch_step(system: System) -> SamplingStep[np.ndarray]:
    """Return the step of a batch, like :func:`single_step`; machine code and NumPy agree to rounding."""
    return _shared(system, batch_kernel, _batch, advance_batch, f"batch steps of {system.name} stay in NumPy")


def _shared(
    system: System,
    compile_kernel: Callable[[System, Motion], Any],
    wrap: Callable[[System, Any], Advance[Values]],
    uncompiled: Callable[..., Values],
    log_line: str,
) -> SamplingStep[Values]:
    """Return the step of a system; systems of one class share a kernel if their programs are equal."""
    plain = functools.partial(uncompiled, system)
    if system.discrete:
        return SamplingStep(plain, f"{system.name} is in discrete time and needs no integration")
    try:
        motion: Any = _motion(system)
    except Exception as error:  # a user's equations may raise any exception on symbols
        motion = _reason(error)
    key = compile_kernel, type(system), motion
    if key not in _kept:
        while len(_kept) >= _KEPT:
            _kept.pop(next(iter(_kept)), None)
        try:
            _kept[key] = motion if isinstance(motion, str) else compile_kernel(system, motion)
        # The error is not raised here: if the equations are at fault, the step in Python raises it.
        except Exception as error:
            _kept[key] = _reason(error)
        if isinstance(_kept[key], str):
            logger.info("%s: %s", log_line, _kept[key])
    kernel = _kept[key]
    return SamplingStep(plain, kernel) if isinstance(kernel, str) else SamplingStep(wrap(system, kernel))


def _reason(error: Exception) -> str:
    """Return the first informative line of an error; Numba's messages are a page long and contain colour codes."""
    line = re.search(r"^(?!Failed in ).*\S.*", re.sub(r"\x1b\[\d*m", "", str(error)), re.MULTILINE)
    return f"{type(error).__name__}: {line[0] if line else ''}"


def _motion(system: System) -> Motion:
    """Return a system's programs; ValueError if they are too long, or differ from one call to the next."""
    nx, nu, constant = system.nx, system.nu, type(system).g is System.g

    def field(x: Any, u: Any = ()) -> Any:
        try:
            return forced(system, [0.0] * nu if constant else u, [0.0] * nx)[0](x)
        except Exception as error:
            blame(error, system, x, [0.0] * nu)
            raise

    letters = [("x", nx)] if constant else [("x", nx), ("u", nu)]
    traced = program(field, *letters)
    if traced != program(field, *letters):
        raise ValueError(f"{system.name}: the equations differ from one call to the next")
    rate = None
    if type(system).rate is not System.rate:
        rate = program(lambda x: (rate_at(system, x),), ("x", nx))
    if len(traced.operations) + len(rate.operations if rate else ()) > MAX_OPERATIONS:
        raise ValueError(f"{system.name}: the equations have more than {MAX_OPERATIONS} operations")
    push = program(lambda u, w: forced(system, u, w)[1], ("u", nu), ("w", nx))
    return Motion(traced, push, rate, per_tolerance(type(system)) + (0.0,) * (len(traced.arguments) - nx))


def single_kernel(system: System, motion: Motion) -> Any:
    """Compile the step of a single state; it returns NaN where substeps of equal length are not accurate enough."""
    import numba

    if not (motion.field.exact and motion.push.exact):
        raise ValueError("there is a power or a remainder, where compilers round unlike Python: write x * x for x**2")
    nx, nu, units, size = system.nx, system.nu, motion.units, len(motion.units)
    x, u, w = ([f"{letter}{i}" for i in range(n)] for letter, n in (("x", nx), ("u", nu), ("w", nx)))
    lines = [
        f"def kernel({', '.join([*x, *u, *w, 'dt'])}):",
        f"    need = {'1.0' if motion.rate is None else f'rate({in_tuple(x)})[0] * dt * {PER_RATE!r}'}",
        f"    d = push({in_tuple([*u, *w])}) + {in_tuple(['0.0'] * (size - nx))}",
        f"    for attempt in range({ATTEMPTS}):",
        f"        if not need <= {MOST_EQUAL}:",
        "            break",
        "        n = 1",
        "        while n < need:",
        "            n *= 2",
        f"        end, error = integrate(field, {in_tuple([*x, *u][:size])}, d, dt / n, n, {units!r})",
        "        if error <= 1.0:",
        f"            return {in_tuple(f'end[{i}]' for i in range(nx))}",
        "        need = n * error**0.1",
        f"    return {in_tuple(['nan'] * nx)}",
    ]
    jit: Any = functools.partial(numba.njit, error_model="python")  # raises ZeroDivisionError where Python does
    # The signature has floats only, so that Numba does not compile the kernel again where an input is an int.
    kernel = jit((numba.float64,) * (nx + nu + nx + 1))(_assembled(motion, lines, jit))
    rng = np.random.default_rng(0)
    u_max, scale = np.array(system.u_max), np.array(system.scale) / system.pace
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for at in map(tuple, np.concatenate(_trial_states(system, rng)).tolist()):
            held, noise = (u_max * rng.uniform(-1, 1, nu)).tolist(), (scale * rng.uniform(-1, 1, nx)).tolist()
            try:
                if not rate_under(system, at, held) * system.dt * PER_RATE <= _MAX_TRIAL_SUBSTEPS:
                    continue
                end = kernel(*at, *held, *noise, system.dt)
            # Where the kernel raises, the step in Python runs instead, so there is nothing to compare.
            except Exception:
                continue
            if end[0] == end[0] and tuple(end) != tuple(advance(system, at, held, noise, system.dt)):
                raise ValueError(f"the compiled step and Python round differently at x = {list(at)}")
    return kernel


def _single(system: System, kernel: Any) -> Advance[Components]:
    def step(x: Components, u: Components, w: Components, dt: float) -> Components:
        try:
            end: Components = kernel(*x, *u, *w, dt)
        # If the equations are at fault, the step in Python raises an error that names them.
        except Exception:
            return advance(system, x, u, w, dt)
        return end if end[0] == end[0] else advance(system, x, u, w, dt)

    return step


def batch_kernel(system: System, motion: Motion) -> Any:
    """Compile the step of a batch: states are sorted by their numbers of substeps, and stepped in groups."""
    import numba

    # Each state of a group is a lane. All components of all lanes lie in one array, at offsets that the compiler knows.
    # The compiler can then use the processor's vector registers.
    nx, nu, units, size = system.nx, system.nu, motion.units, len(motion.units)
    lanes = [f"s[{i * _LANES} + j]" for i in range(size + nx + 3)]
    states, d, (substeps, length, error) = lanes[:size], lanes[size:-3], lanes[-3:]
    start = [*[f"x[{i}, row]" for i in range(nx)], *[f"u[{i}, row]" for i in range(nu)]]
    need = "1.0" if motion.rate is None else f"rate({in_tuple(start[:nx])})[0] * dt * {PER_RATE!r}"
    pushed = f"push({in_tuple([*start[nx:], *[f'w[{i}, row]' for i in range(nx)]])})"
    given = f"{in_tuple(states)}, {in_tuple(d + ['0.0'] * (size - nx))}"
    lines = [
        "def kernel(x, u, w, dt, out):",
        f"    n, s = x.shape[1], np.empty({len(lanes) * _LANES})",
        "    needs, order, counts, left = np.empty(n), np.empty(n, np.int64), np.empty(n), n",
        "    out[:] = nan",
        "    for row in range(n):",
        f"        needs[row] = {need}",
        f"    for attempt in range({ATTEMPTS}):",
        "        found, least, most = 0, -inf, 1.0",
        f"        while found < left and most <= {MOST_EQUAL}:",
        "            for row in range(n):",
        "                if least < needs[row] <= most:",
        "                    order[found], counts[found] = row, most",
        "                    found += 1",
        "            least, most = most, 2.0 * most",
        f"        for first in range(0, found, {_LANES}):",
        f"            for j in range({_LANES}):",
        "                at = min(first + j, found - 1)  # unused lanes repeat the last row",
        f"                row, {substeps}, {length}, {error} = order[at], counts[at], dt / counts[at], 0.0",
        *[f"                {lane} = {value}" for lane, value in zip(states, start)],
        f"                {in_tuple(d)} = {pushed}",
        "            for done in range(int(counts[at])):",
        f"                for j in range({_LANES}):",
        f"                    end, e = integrate(field, {given}, {length}, 1, {units!r})",
        f"                    unfinished = done < {substeps}",
        f"                    {error} = {error} if e <= {error} or not unfinished else e",
        *[f"                    {lane} = end[{i}] if unfinished else {lane}" for i, lane in enumerate(states[:nx])],
        f"            for j in range(min({_LANES}, found - first)):",
        "                row = order[first + j]",
        f"                if {error} <= 1.0:",
        *[f"                    out[{i}, row] = {lane}" for i, lane in enumerate(states[:nx])],
        "                    needs[row] = nan",
        "                    left -= 1",
        "                else:",
        f"                    needs[row] = {substeps} * {error} ** 0.1",
        "    return left > 0",
    ]
    jit: Any = functools.partial(numba.njit, error_model="numpy")  # a division by zero gives infinity
    inlined = functools.partial(jit, forceinline=True)  # a function call would prevent vectorisation over lanes
    kernel = jit(_assembled(motion, lines, inlined))
    u_max, scale = np.array(system.u_max)[:, None], np.array(system.scale)[:, None] / system.pace
    rounding = 1e-9 * np.ptp(system.X, axis=1)[:, None]
    for points in _trial_states(system, np.random.default_rng(0)):
        rng, n = np.random.default_rng(0), len(points)
        at = points.T.copy(), u_max * rng.uniform(-1, 1, (nu, n)), scale * rng.uniform(-1, 1, (nx, n)), system.dt
        found, expected = np.empty((nx, n)), equal_substeps(system, *at)[0]
        kernel(*at, found)
        # Where a motion escapes, one result may be infinite and the other NaN.
        expected[~np.isfinite(expected)] = found[~np.isfinite(found)] = np.nan
        if not np.allclose(found, expected, rtol=1e-9, atol=rounding, equal_nan=True):
            raise ValueError(f"{system.name}: the equations return other values for symbols than for numbers")
    return kernel


def _batch(system: System, kernel: Any) -> Advance[np.ndarray]:
    def step(x: np.ndarray, u: np.ndarray, w: np.ndarray, dt: float) -> np.ndarray:
        out = np.empty(x.shape)
        lost = kernel(*(np.ascontiguousarray(values, dtype=float) for values in (x, u, w)), dt, out)
        # States that became NaN in this step are stepped again, with substeps whose length is adapted to the error.
        if lost and len(rows := np.flatnonzero(np.isnan(out[0]) & ~np.isnan(x).all(0))):
            out[:, rows] = advance_batch(system, x[:, rows], u[:, rows], w[:, rows], dt)
        return out

    return step


def _assembled(motion: Motion, lines: list[str], jit: Callable[..., Any]) -> Any:
    """Return the function ``kernel`` that ``lines`` define; the lines call the compiled programs of ``motion``."""
    namespace: dict[str, Any] = {"inf": math.inf, "nan": math.nan, "np": np}
    for name, function in vars(elementary).items():
        if on_numbers := getattr(function, "on_numbers", None):
            namespace[name] = jit(on_numbers) if isinstance(on_numbers, FunctionType) else on_numbers
    namespace["where"] = jit(lambda condition, a, b: a if condition else b)
    zeros = len(motion.units) - len(motion.field.results)
    programs = {"field": motion.field.lines("field", zeros), "push": motion.push.lines("push")}
    if motion.rate is not None:
        programs["rate"] = motion.rate.lines("rate")
    for name, code in programs.items():
        exec("\n".join(code), namespace)
        namespace[name] = jit(namespace[name])
    namespace["integrate"] = jit(runge_kutta(len(motion.units)))
    exec("\n".join(lines), namespace)
    return namespace["kernel"]


def _trial_states(system: System, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return 400 random trial states, and 600 others: 200 each at bounds or 0, at whole numbers, and at starts."""
    n, (low, high) = _TRIALS, np.array(system.bounds, dtype=float).T
    random = np.concatenate([rng.uniform(*system.box(), (n, system.nx)), rng.uniform(low, high, (n, system.nx))])
    ends = np.choose(rng.choice(3, (n, system.nx)), [low, np.zeros(system.nx), high])
    return random, np.concatenate([ends, np.rint(random[:n]), system.draw_starts(rng, n)])


__all__ = ["SamplingStep", "batch_step", "single_step"]
