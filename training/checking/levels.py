"""How large things are: outputs and their noise, process noise, and the drift at the target."""

from collections.abc import Iterator

import numpy as np
from scipy.optimize import least_squares

from kkl_gym.system import NOISE_SHARE, PROCESS_NOISE, System
from training.checking.finding import Finding, Verdict, number, percent
from training.checking.subject import Subject

LOUD = 0.25  # measurement noise in an output's range
STILL = 1e-9  # range of an output in its size
AT_REST = 1e-3  # range of an output late in motions, in its range over X
WALK, LONG_WALK = 0.3, 1.0  # standard deviation, in X's half-widths, to which process noise leads over a motion
BALANCED = 1e-3  # drift at a target, in X's half-widths times the rate, which is taken for an equilibrium
EXACT = 1e-6  # the same of equilibria that are looked for
STARTS = 20  # from which they are looked for


def outputs(subject: Subject) -> Iterator[Finding]:
    """How far each output ranges, and how noisy it is."""
    system = subject.system
    in_X, along = system.output(subject.inner), system.output(subject.staying)
    noise = np.broadcast_to(np.asarray(system.measurement_noise, dtype=float), (system.ny,))
    for i, level in enumerate(noise):
        name, size = f"y{i + 1}", float(np.ptp(in_X[:, i]))
        if size <= STILL * np.abs(in_X[:, i]).max():
            found = f"{name} is {in_X[0, i]:.4g} everywhere in X"
            yield Finding("output", "problem", found, "let h measure something that moves, or leave this output out")
            continue
        verdict: Verdict = "ok"
        found, advice = f"{name} ranges over {number(size)} in X", ""
        if along.size:
            found += f", {number(np.ptp(along[..., i]))} along motions"
            late = np.ptp(along[len(along) // 2 :, :, i], axis=0).max()
            if not system.nu and late < AT_REST * size:
                found += ", and hardly any more in their second half"
                verdict, advice = "note", "motions come to rest: a shorter duration shows more of how they do"
        found += f"; noise {number(level)} by default, {percent(level / size)} of that in X"
        if level > LOUD * size:
            verdict, advice = "note", f"set measurement_noise: {NOISE_SHARE * size:.2g} is 5 % of the range"
        yield Finding("output", verdict, found, advice)


def target(subject: Subject) -> Iterator[Finding]:
    """Whether the target is an equilibrium, or some input makes it one."""
    system = subject.system
    x = np.array(system.target, dtype=float)
    if x.shape != (system.nx,) or not np.isfinite(x).all():
        yield Finding(
            "target", "problem", f"target = {system.target} is no state", f"return {system.nx} finite numbers"
        )
        return
    matters: Verdict = "problem" if system.nu else "note"  # what a controller should hold
    text = f"target {_listed(x, subject.half)}" + ("" if type(system).target is not System.target else ", the default,")
    for name, box in (("the bounds", system.bounds), ("X", system.X)):
        low, high = np.array(box, dtype=float).T
        if ((x < low) | (x > high)).any():
            verdict: Verdict = matters if name == "the bounds" else "note"
            advice = _equilibria(subject) or f"let target return a state within {name}"
            yield Finding("target", verdict, f"{text} lies beyond {name}", advice)
            return
    u, left = _holding(subject, x)
    if left <= BALANCED:
        yield Finding(
            "target",
            "ok",
            f"{text} is an equilibrium" + (f" under u = {_listed(u, np.array(system.u_max))}" if u.any() else ""),
        )
        return
    drift = _listed(subject.derivative(x[None], u[None])[0], subject.half * subject.rate)
    advice = _equilibria(subject) or "let target return a state at which some input within its bounds holds the system"
    if system.nu:
        found = (
            f"{text} is no equilibrium, and no input within its bounds makes it one: x' = {drift} per second at best"
        )
    else:
        found = f"{text} is no equilibrium: x' = {drift} per second"
    yield Finding("target", matters, found, advice)


def process_noise(subject: Subject) -> Iterator[Finding]:
    """How far the default process noise drives the state, against the drift and against X."""
    system = subject.system
    level = system.process_noise * np.array(system.scale)
    if not level.any():
        yield Finding("process noise", "ok", "none by default")
        return
    with np.errstate(all="ignore"):
        drift = np.sqrt(np.nanmean(system.drift(subject.inner) ** 2, axis=0))
    parts = [
        f"{name} up to {number(size)} per second" + (f" ({percent(size / speed)} of f)" if speed > 0 else "")
        for name, size, speed in zip(system.state_names, level, drift, strict=True)
    ]
    # Uniform in +-level and held for dt, so that its integral has the variance level^2 / 3 dt t.
    walk = float((level * np.sqrt(subject.dt * subject.duration / 3) / subject.half).max())
    found = f"{', '.join(parts)} by default; over {subject.duration:g} s it leads {number(walk)} half-widths of X away"
    if walk > WALK:
        fitting = f"{PROCESS_NOISE / system.pace:.1g}"
        advice = f"set process_noise = {fitting}, which is to this system what the default is to those that ship"
        yield Finding("process noise", "problem" if walk > LONG_WALK else "note", found, advice)
    else:
        yield Finding("process noise", "ok", found)


def _listed(values: np.ndarray, sizes: np.ndarray | float = 1.0) -> str:
    """Numbers in parentheses; those that are nothing beside their sizes are zero."""
    shown = np.where(np.abs(values) < EXACT * sizes, 0.0, values)
    return "(" + ", ".join(f"{value:.4g}" for value in shown) + ")"


def _drift(subject: Subject, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The derivative at a state (nx,) under an input (nu,), in X's half-widths times the rate; large for no number."""
    moved = subject.derivative(x[None], u[None])[0] / (subject.half * subject.rate)
    return np.nan_to_num(moved, nan=1e6, posinf=1e6, neginf=-1e6)


def _holding(subject: Subject, x: np.ndarray) -> tuple[np.ndarray, float]:
    """The input that comes closest to holding a state, and the drift left."""
    u_max = np.array(subject.system.u_max)
    u = np.zeros(len(u_max))
    if len(u) and np.abs(_drift(subject, x, u)).max() > BALANCED:
        u = u_max * least_squares(lambda share: _drift(subject, x, share * u_max), u, bounds=(-1.0, 1.0), gtol=1e-12).x
    return u, float(np.abs(_drift(subject, x, u)).max())


def _equilibria(subject: Subject) -> str:
    """Advice that names equilibria without input in X; empty where none is found."""
    system, found = subject.system, list[np.ndarray]()
    no_input = np.zeros(system.nu)
    low, high = system.box()
    for start in (subject.inner[:STARTS] - low) / (high - low):
        place = least_squares(
            lambda place: _drift(subject, low + place * (high - low), no_input),
            np.clip(start, 1e-3, 1 - 1e-3),
            bounds=(0.0, 1.0),
            xtol=1e-12,
        ).x
        x = low + place * (high - low)
        new = all((np.abs(x - other) > 1e-3 * subject.half).any() for other in found)
        if new and np.abs(_drift(subject, x, no_input)).max() < EXACT:
            found.append(x)
    states = " or ".join(_listed(x, subject.half) for x in found[:2])
    return f"let target return an equilibrium, such as {states}" if found else ""
