"""Simulation of sampling intervals by a sixth-order Runge–Kutta method, in 1, 2, 4, ... substeps of equal length.

The number of substeps follows from the system's own ``rate(x)``, or else is 1; an estimate of the error may raise it.
Single states on Python floats (:func:`advance`) and batches on arrays (:func:`advance_batch`) agree to rounding, 1e-13
of the state in each step. Where equal substeps are not accurate enough, the error sets each substep's length.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from kkl_gym.equations import blame
from kkl_gym.system import Components, System, dot, rate_under
from observers.checks import check_dt

# Largest rate * substep where a system has a formula for its rate. It is half of the largest value at which every
# shipped system, from anywhere in twice its training box, keeps the error after 10 s (Lorenz: 2 s) below 1e-5 of the
# motion's size (tests/kkl_gym/test_simulate.py).
RATE_STEP = 0.4
# This is a millionth less than 1 / RATE_STEP. Without this margin, two rates that differ only by rounding could get
# different numbers of substeps where rate * dt / RATE_STEP is a power of two.
PER_RATE = (1.0 - 1e-6) / RATE_STEP
# Largest accepted estimates of a substep's error, in half-widths of X; the true errors are a thousand times smaller.
# Equal substeps keep to TOLERANCE without a rate formula, and to ROUGH with one; other substeps keep to TOLERANCE.
# TOLERANCE keeps errors of stiff systems, and of shipped ones without formulas, below 1e-5 of the motion's size. ROUGH
# detects where a formula fails, as at an ignition; it is a hundred times the shipped systems' largest estimate.
TOLERANCE, ROUGH = 3e-6, 0.1
# Number of attempts with equal substeps. After them, or beyond MOST_EQUAL substeps, the step length follows the error.
ATTEMPTS = 3
MOST_EQUAL = 1 << 10  # equal substeps in a sampling interval
MAX_SUBSTEPS = 1 << 16  # substeps of any length in a sampling interval
REPORTED = 50  # sampling intervals between two calls of ``report`` by :func:`simulate`

# Butcher's explicit sixth-order method with seven stages (J. C. Butcher, Numerical Methods for Ordinary Differential
# Equations, sec. 31). A method of order four needs four times as many evaluations for the same error on Lorenz.
STAGES = (
    (),
    (1 / 3,),
    (0, 2 / 3),
    (1 / 12, 1 / 3, -1 / 12),
    (-1 / 16, 9 / 8, -3 / 16, -3 / 8),
    (0, 9 / 8, -3 / 8, -3 / 4, 1 / 2),
    (9 / 44, -9 / 11, 63 / 44, 18 / 11, 0, -16 / 11),
)
WEIGHTS = (11 / 120, 0, 27 / 40, 27 / 40, -4 / 15, -4 / 15, 11 / 120)
# The error estimate, of order h^5, is h times the difference between two stages' slopes at mid-step. This difference is
# zero where the derivative depends only on time. Therefore a multiple of the slopes' fourth divided difference over the
# interval is added, with the coefficients (1, 0, -9, -9, 16, 0, 1) / 256.
ERROR = (1 / 256, 0, -9 / 256, -9 / 256, 16 / 256 - 1, 1, 1 / 256)
# For each stage and for the result: coefficients of the state, of a constant slope and of the earlier slopes.
_ROWS = [np.array([1.0, sum(row), *row]) for row in (*STAGES, WEIGHTS)]
_ERROR = np.array(ERROR)

VectorField = Callable[[Any], Any]
Feedback = Callable[[int, np.ndarray], np.ndarray]
"""Maps (k, x) to the inputs held over interval k, (n, nu)."""
Step = Callable[[np.ndarray, np.ndarray, np.ndarray, float], np.ndarray]
"""Maps (x, u, w, dt) to the next x, like :func:`advance_batch`."""


class SubstepsError(ValueError):
    """A sampling interval needs more than MAX_SUBSTEPS substeps: it is too long, or the system is too fast."""


@functools.cache
def runge_kutta(nx: int) -> Callable[[VectorField, Components, Components, float, int, Components], tuple[Any, float]]:
    """Return a function that makes the Runge–Kutta steps of ``STAGES`` and ``WEIGHTS``, in unrolled loops for speed.

    It takes f, x, constants that are added to f, the length h and the number n of steps, and 1 / tolerance of each
    state, (nx,). It returns the state after n steps and the largest squared error of a step, in units of tolerance.
    """
    components = range(nx)

    def unpacked(letter: str) -> str:
        return "".join(f"{letter}{i}, " for i in components)

    def moved(i: int, row: int, coefficients: tuple[float, ...]) -> str:
        return f"x{i}" + "".join(f" + c{row}_{j} * k{j}_{i}" for j, c in enumerate(coefficients) if c)

    rows = (*STAGES, WEIGHTS)
    lines = ["def integrate(f, x, d, h, n, s):", "    error = 0.0"]
    lines += [f"    {unpacked(letter)} = {letter}" for letter in "xds"]
    lines += [f"    c{row}_{j} = h * {c!r}" for row, cs in enumerate(rows) for j, c in enumerate(cs) if c]
    lines += ["    for _ in range(n):"]
    for row, coefficients in enumerate(STAGES):
        at = "".join(moved(i, row, coefficients) + ", " for i in components)
        lines += [f"        {unpacked(f'k{row}_')} = f(({at}))"]
        lines += [f"        k{row}_{i} = k{row}_{i} + d{i}" for i in components]
    lines += [f"        x{i} = {moved(i, len(STAGES), WEIGHTS)}" for i in components]
    for i in components:
        weighted = " + ".join(f"{c!r} * k{j}_{i}" for j, c in enumerate(ERROR) if c)
        lines += [f"        e{i} = h * s{i} * ({weighted})"]
    lines += ["        e = " + " + ".join(f"e{i} * e{i}" for i in components)]
    lines += ["        if not e <= error:", "            error = e"]  # also if e is NaN
    lines += [f"    return ({unpacked('x')}), error"]
    namespace: dict[str, Any] = {}
    exec("\n".join(lines), namespace)
    return namespace["integrate"]


def forced(system: System, u: Components, w: Components) -> tuple[VectorField, Components]:
    """Split x' = f(x) + g(x) u + w, under held u and w, into a vector field and nx constants."""
    if type(system).g is System.g:
        if len(u) == 0:
            return system.f, w
        if len(u) == 1:
            u0 = u[0]
            return system.f, [gi * u0 + wi for (gi,), wi in zip(system.G, w)]
        return system.f, [wi + dot(row, u) for row, wi in zip(system.G, w, strict=True)]

    def field(x: Components) -> list[Any]:
        return [fi + dot(row, u) for fi, row in zip(system.f(x), system.g(x), strict=True)]

    return field, w


def _per_tolerance(kind: type[System], tolerance: float | None = None) -> tuple[float, ...]:
    """Return 1 / tolerance of each state's error, (nx,), for a class of systems."""
    if tolerance is None:
        tolerance = TOLERANCE if kind.rate is System.rate else ROUGH
    return tuple(2.0 / (high - low) / tolerance for low, high in kind.X)


per_tolerance: Callable[..., tuple[float, ...]] = functools.lru_cache(maxsize=256)(_per_tolerance)


def advance(system: System, x: Components, u: Components, w: Components, dt: float) -> Components:
    """Return the state after one sampling interval, from a single state, on Python floats."""
    try:
        try:
            if system.discrete:
                return [xi + wi * dt for xi, wi in zip(system.step(x, u), w, strict=True)]
            kind = type(system)
            need = 1.0 if kind.rate is System.rate else system.rate(x) * dt * PER_RATE
            field, d = forced(system, u, w)
            for _ in range(ATTEMPTS):
                if not need <= MOST_EQUAL:
                    break
                n = 1
                while n < need:
                    n *= 2
                end, error = runge_kutta(len(x))(field, x, d, dt / n, n, per_tolerance(kind))
                if error <= 1.0:
                    return cast(Components, end)
                need = n * error**0.1  # the squared error falls as h^10
        except ArithmeticError:  # Python's **, / and math functions raise where arrays return inf
            found = _on_arrays(system, x, u, w, dt)
            if found is not None:
                return found
        return followed(system, x, u, w, dt=dt, end=(math.nan,) * len(x))
    except SubstepsError:
        raise
    except Exception as error:
        blame(error, system, x, u)
        raise


def _on_arrays(system: System, x: Components, u: Components, w: Components, dt: float) -> Components | None:
    """Return the next state, computed on arrays, where 1 / 0 raises no error; None after an error, inf or NaN."""
    try:
        twice = [np.repeat(np.array(values, dtype=float)[:, None], 2, axis=1) for values in (x, u, w)]
        end: list[float] = advance_batch(system, twice[0], twice[1], twice[2], dt)[:, 0].tolist()
    except Exception:
        return None
    return end if np.isfinite(end).all() else None


def followed(system: System, x: Components, u: Components, w: Components, *, dt: float, end: Components) -> Components:
    """Return the next state by substeps whose length follows the error, or ``end`` if x escapes or turns NaN."""
    # Motions that accelerate, as at an ignition, need such substeps. The substeps also verify an escape: if equal
    # substeps were too long at the end of the interval, their error alone may have carried x out of the bounds.
    if system.discrete:
        return end
    left, h, field, d = dt, dt, *forced(system, u, w)
    step, units = runge_kutta(len(x)), per_tolerance(type(system), TOLERANCE)
    try:
        for _ in range(MAX_SUBSTEPS):
            if not all(low <= xi <= high for xi, (low, high) in zip(x, system.bounds, strict=True)):
                return end
            if left <= 0.0:
                return x
            h = min(h, left)
            moved, error = step(field, x, d, h, 1, units)
            if error <= 1.0:
                x = moved
                left -= h
            elif h < 1e-15 * dt:  # even the shortest steps give NaN
                return end
            h *= 0.9 * max(1e-6, min(1e8, error)) ** -0.1
    except ArithmeticError:
        return end
    except Exception as error:
        blame(error, system, x, u)
        raise
    raise SubstepsError(
        f"{MAX_SUBSTEPS} substeps are not enough for dt = {dt:g} s of {system.name}; {left:.2g} s of it are left at "
        f"x = {[float(xi) for xi in x]}: take a smaller dt, or tighten the bounds"
    )


def advance_batch(system: System, x: np.ndarray, u: np.ndarray, w: np.ndarray, dt: float) -> np.ndarray:
    """Return the states after one interval, from ``x`` (nx, n), each with the substeps that :func:`advance` takes."""
    try:
        if system.discrete:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                moved = system.step(x, u)
                return np.array([np.broadcast_to(xi, x.shape[1:]) for xi in moved], dtype=float) + w * dt
        out, lost = equal_substeps(system, x, u, w, dt)
        rows = np.flatnonzero(np.isnan(out[0])) if lost else np.arange(0)
        return followed_rows(system, x, u, w, dt=dt, end=out, rows=rows)
    except SubstepsError:
        raise
    except Exception as error:
        blame(error, system, x, u)
        raise


def equal_substeps(system: System, x: np.ndarray, u: np.ndarray, w: np.ndarray, dt: float) -> tuple[np.ndarray, bool]:
    """Return the next states (nx, n) by equal substeps, NaN where the error is too large, and whether any is NaN."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        need: Any = 1.0 if type(system).rate is System.rate else system.rate(x) * dt * PER_RATE
        if np.all(need <= 1):
            substeps = np.ones(x.shape[1], int)
            out, error = _step_batch(system, x, u, w, dt)
        else:
            substeps = _powers(np.broadcast_to(need, x.shape[1:]))
            out, error = _substeps(system, x, u, w, dt / np.maximum(substeps, 1), substeps)
            error[substeps == 0] = np.nan
        for _ in range(1, ATTEMPTS):
            rows = np.flatnonzero(error > 1)
            if not len(rows):
                break
            substeps[rows], error[rows] = _powers(substeps[rows] * error[rows] ** 0.1), np.nan
            rows = rows[substeps[rows] > 0]
            n = substeps[rows]
            out[:, rows], error[rows] = _substeps(system, x[:, rows], u[:, rows], w[:, rows], dt / n, n)
    lost = ~(error <= 1)
    out[:, lost] = np.nan
    return out, bool(lost.any())


def _powers(need: np.ndarray) -> np.ndarray:
    """Return the least powers of two (n,) that are at least ``need`` (n,), or 0 where they exceed MOST_EQUAL."""
    mantissa, exponent = np.frexp(np.where(need <= MOST_EQUAL, np.maximum(need, 1), 1))
    return np.where(need <= MOST_EQUAL, 1 << (exponent - (mantissa == 0.5)), 0)


def _substeps(
    system: System, x: np.ndarray, u: np.ndarray, w: np.ndarray, h: np.ndarray, n: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the states (nx, m) after n (m,) >= 1 substeps of length h (m,), and the largest squared errors (m,)."""
    out, error = _step_batch(system, x, u, w, h)
    for k in range(2, n.max(initial=1) + 1):
        rows = np.flatnonzero(n >= k)
        out[:, rows], of_step = _step_batch(system, out[:, rows], u[:, rows], w[:, rows], h[rows])
        error[rows] = np.maximum(error[rows], of_step)
    return out, error


def followed_rows(
    system: System, x: np.ndarray, u: np.ndarray, w: np.ndarray, *, dt: float, end: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Return the states ``end`` (nx, n), recomputed by :func:`followed` in those ``rows`` (m,) where x is in bounds."""
    if len(rows):
        low, high = np.array(system.bounds, dtype=float).T[..., None]
        # Equations may use NumPy even on the floats of a single state, and NumPy would warn.
        with np.errstate(all="ignore"):
            for row in rows[((x[:, rows] >= low) & (x[:, rows] <= high)).all(0)]:
                start = [values[:, row].tolist() for values in (x, u, w)]
                end[:, row] = followed(system, *start, dt=dt, end=end[:, row])
    return end


def _step_batch(system: System, x: np.ndarray, u: np.ndarray, w: np.ndarray, h: Any) -> tuple[np.ndarray, np.ndarray]:
    """Make a Runge–Kutta step of length h, a number or (n,); returns states (nx, n) and squared errors (n,)."""
    # Each stage is one product of its coefficients with x, d and the slopes so far; few large operations are fast.
    field, d = forced(system, u, w)
    rows = np.empty((2 + len(STAGES), *x.shape))
    rows[0] = x
    for out, di in zip(rows[1], d, strict=True):
        np.multiply(di, h, out=out)
    flat = rows.reshape(len(rows), -1)
    at = x
    for stage, slope in enumerate(rows[2:], 1):
        for out, fi in zip(slope, field(at), strict=True):
            np.multiply(fi, h, out=out)
        at = (_ROWS[stage] @ flat[: 2 + stage]).reshape(x.shape)
    square: Any = 0.0
    for error, unit in zip((_ERROR @ flat[2:]).reshape(x.shape), per_tolerance(type(system)), strict=True):
        error *= unit
        square = square + error * error
    return at, square


def simulate(
    system: System,
    x0: np.ndarray,
    steps: int,
    dt: float,
    u: np.ndarray | Feedback | None = None,
    w: np.ndarray | None = None,
    *,
    step: Step | None = None,
    report: Callable[[int], object] | None = None,
) -> np.ndarray:
    """Return trajectories (steps + 1, n, nx) from starts (n, nx), NaN after an escape; ``u`` are inputs or a policy."""
    x0 = np.asarray(x0, dtype=float)
    if x0.ndim != 2 or x0.shape[1] != system.nx or not np.isfinite(x0).all():
        raise ValueError(f"x0 must be finite with shape (n, {system.nx}), got shape {x0.shape}")
    check_dt(dt)
    n = len(x0)
    for name, signal, width in (("u", u, system.nu), ("w", w, system.nx)):
        if signal is not None and not callable(signal) and np.shape(signal) != (steps, n, width):
            raise ValueError(f"{name} must have shape {(steps, n, width)}, got {np.shape(signal)}")
    low, high = (np.array(bound)[:, None] for bound in zip(*system.bounds, strict=True))
    no_u, no_w = np.zeros((system.nu, n)), np.zeros((system.nx, n))
    advanced = step or functools.partial(advance_batch, system)
    out = np.full((steps + 1, n, system.nx), np.nan)
    x = np.ascontiguousarray(x0.T)
    out[0] = x0
    for k in range(steps):
        if report is not None and k % REPORTED == 0:
            report(k)
        acting = u(k, out[k]) if callable(u) else None if u is None else u[k]
        held = (
            no_u if acting is None else np.ascontiguousarray(acting.T),
            no_w if w is None else np.ascontiguousarray(w[k].T),
        )
        end = advanced(x, *held, dt)
        beyond = np.flatnonzero(~((end >= low) & (end <= high)).all(0))
        if len(beyond):
            end = followed_rows(system, x, *held, dt=dt, end=end, rows=beyond)
            end[:, ~((end >= low) & (end <= high)).all(0)] = np.nan
        x = end
        out[k + 1] = x.T
    return out


def check_duration(duration: float, dt: float) -> None:
    """Raise ValueError unless ``duration`` is a finite number of seconds and at least ``dt``."""
    if not dt <= duration < math.inf:
        raise ValueError(f"duration must be finite and at least one sample of dt = {dt} s, got {duration!r}")


def check_interval(system: System, dt: float) -> None:
    """Raise ValueError if a system cannot be simulated at a sampling interval."""
    if not system.discrete:
        rate = float(rate_under(system, tuple(np.mean(system.X, axis=1).tolist()), system.u_max))
        if rate * dt * PER_RATE > MAX_SUBSTEPS:
            longest = 0.95 * MAX_SUBSTEPS / PER_RATE / rate  # the two digits below may be rounded up by 5 %
            raise SubstepsError(
                f"{system.name} changes at a rate of {rate:.4g}/s in the middle of X, for which dt = {dt:g} s would "
                f"need more than {MAX_SUBSTEPS} substeps: take dt <= {longest:.2g} s"
            )
    elif not math.isclose(dt, system.dt, rel_tol=1e-9):
        raise ValueError(f"{system.name} makes only steps of dt = {system.dt} s: got dt = {dt}")
