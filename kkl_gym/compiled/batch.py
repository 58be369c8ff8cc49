"""A batch's Runge–Kutta step as machine code, where Numba is installed: several times as fast.

For the step, the system's own equations are run once on sympy symbols; what comes out is written down as Python, put
into the same step as single states take, and compiled, which takes a second for each system, set of parameters and
process. Rows go through it many at a time, one in each lane of the processor's vectors.
"""

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kkl_gym.compiled.step import Advance, SamplingStep, shared_step, trial_states
from kkl_gym.equations import components, input_matrix, rate_at
from kkl_gym.simulate import ATTEMPTS, MOST_EQUAL, PER_RATE, advance_batch, equal_substeps, per_tolerance, runge_kutta
from kkl_gym.system import System

MAX_OPERATIONS = 400  # of f + g u; beyond, such as for a network as f, compiling takes many seconds
_TRIALS = 200  # states of each kind at which both are compared
_LANES = 32  # rows that make a step together: a few of the processor's vectors


@dataclass(frozen=True)
class CompiledBatch:
    """A kernel and the system that it is of, called as ``step(x, u, w, dt)``."""

    system: System
    kernel: Any

    def __call__(self, x: np.ndarray, u: np.ndarray, w: np.ndarray, dt: float) -> np.ndarray:
        """The next states, (nx, n), from states (nx, n), inputs (nu, n) and process noise (nx, n)."""
        out, lost = self._substeps(x, u, w, dt)
        if lost:
            rows = np.flatnonzero(np.isnan(out[0]) & ~np.isnan(x[0]))  # motions that are lost stay so
            out[:, rows] = advance_batch(self.system, x[:, rows], u[:, rows], w[:, rows], dt)
        return out

    def check(self) -> None:
        """Raise ValueError if NumPy makes other steps from any of many states.

        Equations such as ``1 if x[0] == 0 else ...`` mean something else to symbols. And what they read may have
        changed since they were compiled.
        """
        system, nx, nu = self.system, self.system.nx, self.system.nu
        u_max, scale = np.array(system.u_max)[:, None], np.array(system.scale)[:, None] / system.pace
        rounding = 1e-9 * np.ptp(system.X, axis=1)[:, None]
        for points in trial_states(system, _TRIALS, np.random.default_rng(0)):
            rng, n = np.random.default_rng(0), len(points)
            at = points.T, u_max * rng.uniform(-1, 1, (nu, n)), scale * rng.uniform(-1, 1, (nx, n)), system.dt
            found, expected = self._substeps(*at)[0], equal_substeps(system, *at)[0]
            expected[~np.isfinite(expected)] = found[~np.isfinite(found)] = np.nan  # what escapes may be either
            if not np.allclose(found, expected, rtol=1e-9, atol=rounding, equal_nan=True):
                raise ValueError(f"{system.name}: what the equations say to symbols is not what they say to numbers")

    def _substeps(self, x: np.ndarray, u: np.ndarray, w: np.ndarray, dt: float) -> tuple[np.ndarray, bool]:
        """What NumPy's substeps of one length make of it, NaN where they do not do, and whether there are such."""
        out = np.empty(x.shape)
        try:
            lost = self.kernel(*(np.ascontiguousarray(values, dtype=float) for values in (x, u, w)), dt, out)
        except ArithmeticError:  # negative powers of zero, which Numba raises even so
            return equal_substeps(self.system, x, u, w, dt)
        return out, lost


def batch_step(system: System) -> SamplingStep[np.ndarray]:
    """One sampling interval of a batch: compiled if Numba and sympy are there and take the equations, else NumPy.

    The two agree to rounding. Equations that sympy cannot read, such as those with NumPy functions or ``if``, go on
    with NumPy. So do those with which the two disagree anywhere they are compared. :mod:`kkl_gym.elementary` has
    functions that serve both. What the equations read besides must not change while the step is in use: they are
    compared each time this is called, and compiled anew where they say something else. The logger ``kkl_gym`` says at
    level INFO, once for each system, that NumPy goes on and why. Systems in discrete time are not integrated, and make
    their steps in NumPy.
    """
    said = f"{system.name} goes on with NumPy, not compiled"
    return shared_step(system, compiled_step, advance_batch, said=said, again=_again)


def _again(step: Advance[np.ndarray], system: System) -> Advance[np.ndarray]:
    """The kernel of a step for another system that it should be the same of; ValueError if it is not."""
    assert isinstance(step, CompiledBatch)
    found = replace(step, system=system)
    found.check()
    return found


def compiled_step(system: System) -> CompiledBatch:
    """The compiled step of :func:`batch_step`."""
    import numba
    import sympy

    compiled: Any = functools.partial(numba.njit, error_model="numpy")  # a division by zero is infinite
    inlined = functools.partial(compiled, forceinline=True)  # a call would keep rows from going through together
    nx, nu = system.nx, system.nu
    x, u = (list(sympy.symbols(f"{letter}:{n}", real=True)) for letter, n in (("x", nx), ("u", nu)))

    def traced() -> list[Any]:
        return [
            sympy.sympify(fi + sum(gij * uj for gij, uj in zip(row, u, strict=True)))
            for fi, row in zip(components(system.f, x), input_matrix(system, x), strict=True)
        ]

    forced = traced()
    if forced != traced():
        raise ValueError(f"{system.name}: the equations are not the same each time they are asked for")
    if sympy.count_ops(forced) > MAX_OPERATIONS:
        raise ValueError(f"{system.name}: the equations take too long to compile")
    # The input is held: a part of the state whose derivative is zero.
    field = sympy.lambdify([(*x, *u)], (*forced, *[sympy.Float(0)] * nu), "math", cse=True)
    namespace: dict[str, Any] = {
        "field": inlined(field),
        "integrate": inlined(runge_kutta(nx + nu)),
        "inf": math.inf,
        "nan": math.nan,
        "np": np,
    }
    if rated := type(system).rate is not System.rate:
        rate = sympy.sympify(rate_at(system, x)).replace(_is_root, lambda power: sympy.sqrt(power.base))
        namespace["rate"] = inlined(sympy.lambdify([x], rate, "math", cse=True))
    exec("\n".join(_kernel_lines(system, rated=rated)), namespace)
    found = CompiledBatch(system, compiled(namespace["kernel"]))
    found.check()  # compiles, or says why not
    return found


def _is_root(expression: Any) -> bool:
    """Whether sympy holds it for a power, of which the square root takes a fraction of the time."""
    return bool(expression.is_Pow and expression.exp == 0.5)


def _kernel_lines(system: System, *, rated: bool) -> list[str]:
    """Python of the kernel: substeps of one length for each row, in groups of rows that need as many.

    Components and lanes are written out, and lie in one array at distances that the compiler knows. That is what lets
    it use the processor's vectors.
    """

    def lane(i: int) -> str:
        return f"s[{i * _LANES} + j]"

    def tupled(values: list[str]) -> str:
        return "(" + "".join(f"{value}, " for value in values) + ")"

    nx, nu = system.nx, system.nu
    held = [*[f"x[{i}, row]" for i in range(nx)], *[f"u[{i}, row]" for i in range(nu)]]
    held += [f"w[{i}, row]" for i in range(nx)]
    lanes = [lane(i) for i in range(len(held) + 3)]
    states, noise, (substeps, length, error) = lanes[:nx], lanes[nx + nu : -3], lanes[-3:]
    need = f"rate({tupled(held[:nx])}) * dt * {PER_RATE!r}" if rated else "1.0"
    given = f"{tupled(lanes[: nx + nu])}, {tupled(noise + ['0.0'] * nu)}"
    units = per_tolerance(type(system)) + (0.0,) * nu
    return [
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
        "                at = min(first + j, found - 1)  # lanes that are left over do the last row again",
        f"                row, {substeps}, {length}, {error} = order[at], counts[at], dt / counts[at], 0.0",
        *[f"                {lanes[i]} = {value}" for i, value in enumerate(held)],
        "            for done in range(int(counts[at])):",
        f"                for j in range({_LANES}):",
        f"                    end, e = integrate(field, {given}, {length}, 1, {units!r})",
        f"                    unfinished = done < {substeps}",
        f"                    {error} = {error} if e <= {error} or not unfinished else e",
        *[f"                    {value} = end[{i}] if unfinished else {value}" for i, value in enumerate(states)],
        f"            for j in range(min({_LANES}, found - first)):",
        "                row = order[first + j]",
        f"                if {error} <= 1.0:",
        *[f"                    out[{i}, row] = {value}" for i, value in enumerate(states)],
        "                    needs[row] = nan",
        "                    left -= 1",
        "                else:",
        f"                    needs[row] = {substeps} * {error} ** 0.1",
        "    return left > 0",
    ]
