"""How a system moves: how fast, within which bounds, and how that goes with the sampling."""

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

import numpy as np

from kkl_gym.envs import KKLEnv
from kkl_gym.simulate import RATE_STEP, SubstepsError, simulate
from kkl_gym.system import Box, System, rate_under
from training.checking.finding import Finding, Verdict, number, percent
from training.checking.subject import Motions, Subject
from training.systems import named_policy

TOO_LOW, TOO_HIGH = 0.5, 20.0  # rate(x) in multiples of what the Jacobian says
TIMED = 300  # steps of the environment
SLOW = 500.0  # microseconds of such a step
MANY = 0.5  # share of motions from X that leave the bounds
FEW = 0.1  # share of motions that run away where wider bounds help
WIDER = 10.0  # times as wide are the bounds in which motions are followed that leave the declared ones
ROOM = 1.1  # of bounds around those motions
HELD = 1.0  # rate * dt from which on a regulator of continuous time may fail, since its actions are held
COARSE, JERKY = 1.0, 0.5  # changes of y from sample to sample, in its standard deviations along a motion
SMOOTH = 0.1  # that change with a good sampling interval
IDLE = 1e-4  # that change where hardly any sample tells something new
ZERO = 1e-4  # part of the fastest eigenvalue below which one is taken for zero


def rate(subject: Subject) -> Iterator[Finding]:
    """What System.rate says, against the Jacobian, and the substeps that follow."""
    system, dt = subject.system, subject.dt
    if system.discrete:
        return
    typical, own = system.typical_rate, type(system).rate is not System.rate
    x = np.concatenate([subject.inner, subject.outer])
    with np.errstate(all="ignore"):
        worst = float(np.nanmax(rate_under(system, subject.everywhere.T, system.u_max)))
        said = np.broadcast_to(np.asarray(rate_under(system, x.T, system.u_max), dtype=float), len(x))
        norm = float(np.nanmedian(System.rate(system, x.T)))
    fastest = np.abs(np.linalg.eigvals(subject.jacobian(x))).max(1)
    found = f"typically {number(typical)}/s in X, at most {number(worst)}/s within the bounds"
    if own:
        found += f": {_substeps(typical, dt)} and {_substeps(worst, dt)} substeps of dt = {dt:g} s"
    usual, of = (norm, "norm") if own else (float(np.median(fastest)), "fastest eigenvalue")
    if own and (np.median(said) < TOO_LOW * np.median(fastest) or _too_long(said, fastest, dt)):
        found += f". That is too little: the fastest eigenvalue of df/dx is {number(np.median(fastest))}/s at the "
        found += f"median over 2X, {number(fastest.max())}/s at most"
        advice = f"leave rate(x) out, whose default says {number(norm)}/s at the median, or raise it: substeps, dt and "
        yield Finding("rate", "problem", found, advice + "eigenvalues follow from it")
    elif np.median(said) > TOO_HIGH * usual > 0:
        found += f". The {of} of df/dx is {number(usual)}/s at the median over 2X"
        advice = "lower rate(x): substeps are wasted" if own else "let X's half-widths fit how far each state moves"
        yield Finding("rate", "note", found, advice)
    else:
        yield Finding("rate", "ok", found)


def speed(subject: Subject) -> Iterator[Finding]:
    """Time of a step of the environment."""
    env = KKLEnv(subject.system, dt=subject.dt)
    env.reset(seed=0)
    spent = 0.0
    for action in np.random.default_rng(0).uniform(-1, 1, (TIMED, subject.system.nu)).astype(np.float32):
        start = time.perf_counter()
        *_, terminated, _, _ = env.step(action)
        spent += time.perf_counter() - start
        if terminated:
            env.reset()
    each = 1e6 * spent / TIMED
    own = subject.system.discrete or type(subject.system).rate is not System.rate
    advice = "lower rate(x), or dt" if own else "lower dt, or write f in fewer operations"
    slow = each > SLOW
    found = f"a step of one environment takes {each:.0f} µs"
    yield Finding("speed", "note" if slow else "ok", found, advice if slow else "")


def bounds(subject: Subject) -> Iterator[Finding]:
    """Whether motions stay within the bounds, and which bounds would hold them."""
    motions = subject.motions
    if isinstance(motions, SubstepsError):
        raise motions
    lost = ~motions.stays
    followed = f"motions of {subject.duration:g} s"
    if not lost.any():
        kinds = " and ".join(motions.kinds)
        yield Finding("bounds", "ok", f"all of {len(lost)} {followed} stay within them, from X and 2X, {kinds}")
        return
    beyond = _beyond(subject, motions)
    for origin in ("X", "2X"):
        rows = motions.rows(origin)
        if not (lost & rows).any():
            yield Finding("bounds", "ok", f"all of {rows.sum()} {followed} from {origin} stay within them")
            continue
        counts = [lost[motions.rows(origin, kind)] for kind in motions.kinds]
        parts = [f"{one.sum()} of {len(one)} {kind}" for one, kind in zip(counts, motions.kinds)]
        when, where = _exits(subject, beyond[:, rows[lost]])
        found = (
            f"of {followed} from {origin}, {' and '.join(parts)} leave them, after {number(np.median(when))} s at the "
        )
        found += f"median, most often {where}"
        share = max(one.mean() for one in counts)
        if origin == "X" and share > MANY:
            yield Finding("bounds", "problem", found, _way_out(subject, beyond[:, rows[lost]], unstable=True))
            return
        yield Finding("bounds", "note", found, _way_out(subject, beyond[:, rows[lost]], unstable=False))


def sampling(subject: Subject) -> Iterator[Finding]:
    """The sampling interval and the duration against the system's time constants and the output's changes."""
    system, dt, duration = subject.system, subject.dt, subject.duration
    found, advice = [f"dt = {dt:g} s, motions of {duration:g} s"], list[str]()
    verdict: Verdict = "ok"
    if not system.discrete:
        suggested = System.dt.fget(system)  # type: ignore[attr-defined]
        found[0] += f" (the rate suggests {suggested:g} and {5000 * suggested:g} s)"
        fastest, slowest = time_constants(subject)
        if np.isfinite(slowest):
            found.append(
                f"time constants {number(fastest)} to {number(slowest)} s (medians over X), of which the fastest spans "
                f"{number(fastest / dt)} samples and a motion {number(duration / slowest)} of the slowest"
            )
            if duration < slowest:
                verdict = "note"
                advice.append(f"motions end before the slow part has moved: take a duration of {5 * slowest:.1g} s")
    change = _change(subject)
    if np.isfinite(change):
        found.append(f"y changes by {percent(change)} of its standard deviation from sample to sample")
        way = "" if system.discrete else f": take dt = {_preferred(dt * SMOOTH / change):g} s"
        if change > JERKY:
            verdict = "problem" if change > COARSE else "note"
            advice.append(("the motion between samples is lost" if change > COARSE else "samples are few") + way)
        elif change < IDLE:
            verdict = "note"
            advice.append("samples tell hardly anything new" + way)
    yield Finding("sampling", verdict, "; ".join(found), "; ".join(advice))


def time_constants(subject: Subject) -> tuple[float, float]:
    """The fastest and the slowest time constant of the linearised system in seconds, medians over X.

    Infinite where nothing changes; eigenvalues of zero have none.
    """
    sizes = np.abs(np.linalg.eigvals(subject.jacobian(subject.inner)))
    sizes = sizes[sizes.max(1) > 0]
    if not len(sizes):
        return np.inf, np.inf
    slow = np.where(sizes > ZERO * sizes.max(1, keepdims=True), sizes, np.inf).min(1)
    return float(1 / np.median(sizes.max(1))), float(1 / np.median(slow))


def _substeps(rate: float, dt: float) -> int:
    return 1 << max(0, int(np.ceil(np.log2(rate * dt / RATE_STEP))))


def _too_long(said: np.ndarray, fastest: np.ndarray, dt: float) -> bool:
    """Whether substeps by what is said are far too long for the Jacobian at more than a point in a hundred."""
    if len(said) != len(fastest):
        return False
    steps = np.minimum(dt, RATE_STEP / np.maximum(said, np.finfo(float).tiny))
    return bool((steps * fastest > RATE_STEP / TOO_LOW).mean() > 0.01)


def _beyond(subject: Subject, motions: Motions) -> np.ndarray:
    """The motions that leave, in bounds WIDER times as wide, (steps + 1, n, nx)."""
    lost = ~motions.stays
    try:
        x0, u = motions.x[0, lost], motions.u[:, lost]
        return simulate(_wider(subject.system), x0, len(u), subject.dt, u=u, step=subject.step)
    except SubstepsError:  # too fast out there
        return motions.x[:, lost]


def _exits(subject: Subject, x: np.ndarray) -> tuple[np.ndarray, str]:
    """When motions (steps + 1, n, nx) leave the bounds, in seconds (n,), and through which most do."""
    system = subject.system
    low, high = np.array(system.bounds, dtype=float).T
    first = (~((x >= low) & (x <= high)).all(-1)).argmax(0)
    at = x[first, np.arange(x.shape[1])]
    excess = np.concatenate([low - at, at - high], axis=1) / np.tile(high - low, 2)
    known = np.isfinite(excess).all(1)
    if not known.any():
        return first * subject.dt, "far beyond them within a sample"
    above, i = divmod(int(np.bincount(excess[known].argmax(1), minlength=2 * system.nx).argmax()), system.nx)
    bound = f"above {high[i]:g}" if above else f"below {low[i]:g}"
    return first * subject.dt, f"{system.state_names[i]} {bound}"


def _way_out(subject: Subject, x: np.ndarray, *, unstable: bool) -> str:
    """What to change so that motions stay that have been followed in wider bounds, (steps + 1, n, nx)."""
    system = subject.system
    if subject.policy:
        return "let the policy hold the system from all of X, widen the bounds, shrink X, or take a smaller dt"
    held = np.isfinite(x[-1]).all(-1)
    if held.mean() >= 1 - FEW:
        reached = np.array([x[:, held].min((0, 1)), x[:, held].max((0, 1))]).T
        widened = [
            f"of {name} to ({min(low, _outwards(least)):g}, {max(high, _outwards(most)):g})"
            for name, (low, high), (least, most) in zip(system.state_names, system.bounds, reached, strict=True)
            if least < low or most > high
        ]
        return "widen the bounds " + " and ".join(widened)
    away = f"they run away, also in bounds {WIDER:g} times as wide: "
    if not unstable:
        return away + "shrink X, or let it be, as training leaves them out"
    if not system.nu:
        return away + "shrink X"
    return away + f"shrink X, or {_policy(subject)}"


def _policy(subject: Subject) -> str:
    """What to do about a system that runs away under random inputs."""
    try:
        policy = named_policy(subject.system, "controller")
        motions = replace(subject, policy=policy).motions
    except ValueError:  # no such controller
        motions = SubstepsError()
    if not isinstance(motions, SubstepsError):
        stays = motions.stays[motions.rows("X")]
        if stays.mean() > MANY:
            return f"train with --policy controller, under which {stays.sum()} of {len(stays)} stay"
    found = "train under a policy of yours that holds the system: --policy script.py:function"
    if subject.system.discrete or subject.rate * subject.dt < HELD:
        return found
    return f"{found}, or take a smaller dt, at which the controller may do"


def _wider(system: System) -> System:
    low, high = np.array(system.bounds, dtype=float).T
    centre, half = (low + high) / 2, WIDER * (high - low) / 2
    kind = type(system)

    class Wider(kind):  # type: ignore[misc, valid-type]
        name: ClassVar[str] = f"{system.name}-wider"
        bounds: ClassVar[Box] = tuple(zip((centre - half).tolist(), (centre + half).tolist()))

    return Wider(**system.parameters)


def _outwards(value: float) -> float:
    """A round number with some room."""
    return float(f"{ROOM * value:.2g}")


def _change(subject: Subject) -> float:
    """Root mean square change of the outputs from sample to sample, in standard deviations; NaN if none moves."""
    if not subject.staying.size:
        return np.nan
    y = subject.system.output(subject.staying)
    spread, step = np.sqrt(y.var(0).mean(0)), np.sqrt((np.diff(y, axis=0) ** 2).mean((0, 1)))
    moving = spread > 0
    return float((step[moving] / spread[moving]).max()) if moving.any() else np.nan


def _preferred(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is no larger."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * (1 + 1e-9)))
