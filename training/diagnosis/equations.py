"""Whether the equations are what the package takes: on every kind of number, everywhere within the bounds."""

import importlib.util
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from kkl_gym import EquationError
from kkl_gym.compiled import single_step
from kkl_gym.equations import components, input_matrix, rate_at
from kkl_gym.system import System
from training.diagnosis.finding import Finding, Verdict, number, percent
from training.diagnosis.subject import POINTS, Subject, of_bounds, of_X

COMPARED = 100  # points of X, and as many of the bounds, at which the kinds of numbers are compared
LEAST_EFFECT = 1e-11  # of an input at its bound within a sampling interval, in half-widths of X

Evaluation = Callable[[Any], list[Any]]  # from components of a state to all that the equations say there
COST = {
    "floats": "single environments and observers do not run",
    "arrays": "batches, training and evaluation do not run",
    "tensors": "no map of --pipeline spinn can be trained",
    "symbols": "no Kalman filter, no choice of a spectrum, no monitor of nonlinear outputs, no --pipeline spinn, and "
    "batches are not compiled",
}


def declaration(system: System) -> Iterator[Finding]:
    """States, inputs and parameters."""
    bounds = ", ".join(f"{u_max:g}" for u_max in system.u_max)
    values = ", ".join(f"{name} = {value:g}" for name, value in system.parameters.items())
    found = f"{system.name}: {system.nx} state{'s' * (system.nx > 1)} ({', '.join(system.state_names)}); "
    found += f"{system.nu} input{'s' * (system.nu > 1)} up to {bounds}; " if system.nu else "no inputs; "
    found += f"parameters {values}" if values else "no parameters"
    yield Finding("system", "ok", found + (f"; steps of {system.dt:g} s of its own" if system.discrete else ""))


def starts(system: System) -> Iterator[Finding]:
    """What a draw_starts of the user's returns."""
    if type(system).draw_starts is System.draw_starts:
        return
    low, high = np.array(system.bounds, dtype=float).T
    for factor in (1.0, 2.0):
        x, call = of_X(system, COMPARED, factor), f"draw_starts(rng, {COMPARED}, {factor:g})"
        if np.shape(x) != (COMPARED, system.nx):
            raise ValueError(f"{call} returns starts of shape {np.shape(x)}; return ({COMPARED}, {system.nx})")
        if outside := (~((x >= low) & (x <= high)).all(1)).mean():
            found = f"{percent(outside)} of the starts of {call} lie beyond the bounds"
            raise ValueError(f"{found}; draw them within the bounds, or widen those")
    yield Finding("starts", "ok", "draw_starts of its own, all within the bounds")


def kinds_of_numbers(system: System) -> Iterator[Finding]:
    """The equations on floats, arrays, tensors and symbols: do they work, and say the same."""
    x = np.concatenate([of_X(system, COMPARED), of_bounds(system, COMPARED)])
    expected, agreeing = None, list[str]()
    for kind, evaluated in (("floats", _floats), ("arrays", _arrays), ("tensors", _tensors), ("symbols", _symbols)):
        verdict: Verdict = "problem" if kind in ("floats", "arrays") else "note"
        try:
            with np.errstate(all="ignore"):
                values = evaluated(_everything(system), x)
        except (EquationError, NotImplementedError) as error:
            yield Finding("equations", verdict, f"on {kind}: {error}", f"as it is, {COST[kind]}")
            continue
        if expected is None:
            expected = values
        apart = _apart(expected, values, rate=not system.discrete)
        if apart.any():
            where = np.array2string(x[int(apart.argmax())], separator=", ", precision=4)
            found = f"on {kind} they do not say what they say on {agreeing[0]}, such as at x = {where}"
            advice = "let them depend on state, input and parameters alone; replace `if` by kkl_gym.elementary.where"
            yield Finding("equations", "problem", found, advice)
            continue
        agreeing.append(kind)
    if agreeing:
        parts = "step and h" if system.discrete else "f, g, h and rate"
        agree = f" and agree at {len(x)} points" if len(agreeing) > 1 else ""
        yield Finding("equations", "ok", f"{parts} work on {', '.join(agreeing)}{agree}")


def machine_code(subject: Subject) -> Iterator[Finding]:
    """Whether batches and single environments run as machine code."""
    obstacle = subject.step.obstacle
    if importlib.util.find_spec("numba") is None:
        yield Finding("compiled", "note", "Numba is not installed: batches run on NumPy", 'pip install "kkl-gym[fast]"')
    elif subject.system.discrete:
        yield Finding("compiled", "ok", "nothing to compile: the system is not integrated")
    elif obstacle is None:
        slow = single_step(subject.system).obstacle
        singly = "and so do single ones" if slow is None else f"single ones take their steps in Python ({slow})"
        yield Finding("compiled", "ok", f"large batches of environments run as machine code, {singly}")
    else:
        found = f"batches run on NumPy, several times slower: {obstacle}"
        advice = "write the equations in arithmetic and functions of kkl_gym.elementary, if speed matters"
        yield Finding("compiled", "note", found, advice)


def finite(subject: Subject) -> Iterator[Finding]:
    """Whether f and h are numbers in X, in 2X and within the bounds."""
    system, shares, where = subject.system, list[str](), ""
    for name, x in subject.points.items():
        with np.errstate(all="ignore"):
            bad = ~np.isfinite(np.concatenate([system.drift(x), system.output(x)], axis=1)).all(1)
        if bad.any():
            shares.append(f"{percent(bad.mean())} of {name}")
            where = where or np.array2string(x[bad][0], separator=", ", precision=4)
    if not shares:
        yield Finding("finite", "ok", f"f and h are finite at {POINTS} points each of {', '.join(subject.points)}")
        return
    found = f"f or h is no finite number in {', '.join(shares)}, such as at x = {where}"
    yield Finding(
        "finite", "problem", found, "draw the bounds, and X, where the equations hold, or change the equations"
    )


def inputs(subject: Subject) -> Iterator[Finding]:
    """Whether each input moves something within a sampling interval."""
    system, x = subject.system, subject.points["X"].T
    for j, u_max in enumerate(system.u_max):
        ends = []
        for size in (u_max, 0.0):
            u = np.zeros((system.nu, POINTS))
            u[j] = size
            ends.append(subject.step(x, u, np.zeros_like(x), subject.dt))
        speed = np.sqrt(np.nanmean((ends[0] - ends[1]) ** 2, axis=1)) / subject.dt
        most = int((speed / subject.half).argmax())
        if speed[most] * subject.dt <= LEAST_EFFECT * subject.half[most]:
            advice = f"give column {j + 1} of G, or of g(x), its numbers"
            yield Finding("inputs", "problem", f"input {j + 1} moves no state", advice)
            continue
        moved = f"{system.state_names[most]} by {number(speed[most])} per second"
        yield Finding("inputs", "ok", f"input {j + 1} at its bound {u_max:g} moves {moved}")


def _everything(system: System) -> Evaluation:
    """All that the equations say of a state, one after the other."""
    half = [0.5 * u_max for u_max in system.u_max]

    def evaluation(x: Any) -> list[Any]:
        if system.discrete:
            return [*components(system.step, x, half), *components(system.h, x)]
        rows = [gij for row in input_matrix(system, x) for gij in row]
        return [*components(system.f, x), *rows, *components(system.h, x), rate_at(system, x)]

    return evaluation


def _floats(evaluation: Evaluation, x: np.ndarray) -> np.ndarray:
    rows: list[list[float]] = []
    for point in x.tolist():
        try:
            rows.append([float(value) for value in evaluation(point)])
        except EquationError as error:
            if not isinstance(error.__cause__, ArithmeticError):  # 1 / 0, which is infinite in arrays
                raise
            rows.append([])
    width = max(map(len, rows))
    return np.array([row or [np.nan] * width for row in rows])


def _arrays(evaluation: Evaluation, x: np.ndarray) -> np.ndarray:
    return np.stack([np.broadcast_to(value, len(x)) for value in evaluation(x.T)], axis=-1)


def _tensors(evaluation: Evaluation, x: np.ndarray) -> np.ndarray:
    import torch

    values = evaluation(torch.tensor(x).unbind(-1))
    return np.stack([torch.as_tensor(value, dtype=torch.float64).expand(len(x)).numpy() for value in values], axis=-1)


def _symbols(evaluation: Evaluation, x: np.ndarray) -> np.ndarray:
    import sympy

    symbols = list(sympy.symbols(f"x:{x.shape[1]}", real=True))
    values = sympy.lambdify(symbols, [sympy.sympify(value) for value in evaluation(symbols)], "numpy", cse=True)(*x.T)
    return np.stack([np.broadcast_to(np.asarray(value, dtype=float), len(x)) for value in values], axis=-1)


def _apart(expected: np.ndarray, values: np.ndarray, *, rate: bool) -> np.ndarray:
    """At which points (n,) two kinds of numbers disagree, where both give numbers; of a rate, the last, digits do."""
    if expected.shape != values.shape:
        return np.ones(len(expected), dtype=bool)
    size = np.nanmax(np.where(np.isfinite(expected), np.abs(expected), 0.0), axis=0)
    both = np.isfinite(expected) & np.isfinite(values)
    with np.errstate(invalid="ignore"):
        part = np.full(expected.shape[1], 1e-6)
        part[-1:] = 1e-3 if rate else 1e-6
        return np.asarray((both & (np.abs(expected - values) > part * np.abs(expected) + 1e-9 * size)).any(1))
