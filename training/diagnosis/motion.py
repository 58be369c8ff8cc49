"""How a system moves: how fast, within which bounds, and how that goes with the sampling."""

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

import numpy as np

from kkl_gym.simulate import SubstepsError, simulate
from kkl_gym.system import Box, System, rate_under
from training.diagnosis.finding import Finding, Verdict, number, percent
from training.diagnosis.subject import Subject
from training.systems import named_policy

TOO_LOW = 0.5  # rate(x), in the fastest eigenvalue of the Jacobian
MANY = 0.5  # share of motions that leave the bounds
FEW = 0.1  # share of motions that run away where wider bounds help
WIDER = 10.0  # times as wide are the bounds in which motions are followed that leave the declared ones
BEYOND = 12  # of them, at most
ROOM = 1.1  # of bounds around those motions
COARSE, JERKY = 1.0, 0.5  # changes of y from sample to sample, in its standard deviations along a motion
SMOOTH = 0.1  # that change with a good sampling interval
IDLE = 1e-4  # that change where hardly any sample tells something new
ZERO = 1e-4  # part of the fastest eigenvalue below which one is taken for zero


def bounds(subject: Subject) -> Iterator[Finding]:
    """Whether motions from X stay within the bounds, and which bounds would hold them."""
    (x, u), lost = subject.motions, ~subject.stays
    followed = f"{len(lost)} motions of {subject.duration:g} s from X"
    if not lost.any():
        yield Finding("bounds", "ok", f"all of {followed}, {' and '.join(subject.kinds)}, stay within them")
        return
    some = np.flatnonzero(lost)
    some = some[np.linspace(0, len(some) - 1, min(BEYOND, len(some))).round().astype(int)]
    try:
        beyond = simulate(_wider(subject.system), x[0, some], len(u), subject.dt, u=u[:, some], step=subject.step)
    except SubstepsError:  # too fast out there
        beyond = x[:, some]
    counts = np.split(lost, len(subject.kinds))
    parts = [f"{one.sum()} of {len(one)} {kind}" for one, kind in zip(counts, subject.kinds)]
    when = subject.dt * np.median(np.isfinite(x[:, lost]).all(-1).sum(0))
    found = f"of {followed}, {' and '.join(parts)} leave them, after {number(when)} s at the median"
    unstable = max(one.mean() for one in counts) > MANY
    yield Finding("bounds", "problem" if unstable else "note", found, _way_out(subject, beyond, unstable=unstable))


def rate(subject: Subject) -> Iterator[Finding]:
    """What System.rate says, against the Jacobian."""
    system = subject.system
    if system.discrete:
        return
    typical = system.typical_rate
    with np.errstate(all="ignore"):
        worst = float(np.nanmax(rate_under(system, subject.points["the bounds"].T, system.u_max)))
    found = f"typically {number(typical)}/s in X, at most {number(worst)}/s within the bounds"
    x = np.concatenate([subject.points["X"], subject.points["2X"]])
    with np.errstate(all="ignore"):
        own = np.broadcast_to(np.asarray(rate_under(system, x.T, system.u_max), dtype=float), len(x))
    fastest = np.median(np.abs(np.linalg.eigvals(subject.jacobian(x))).max(1))
    if type(system).rate is System.rate or np.median(own) >= TOO_LOW * fastest:
        yield Finding("rate", "ok", found)
        return
    found += f". That is too little: the fastest eigenvalue of df/dx is {number(fastest)}/s at the median over 2X"
    advice = "leave rate(x) out, or raise it: substeps, dt and eigenvalues follow from it"
    yield Finding("rate", "problem", found, advice)


def sampling(subject: Subject) -> Iterator[Finding]:
    """The sampling interval and the duration against the system's time constants and the output's changes."""
    system, dt, duration = subject.system, subject.dt, subject.duration
    found, advice = f"dt = {dt:g} s, motions of {duration:g} s", list[str]()
    verdict: Verdict = "ok"
    if not system.discrete:
        fastest, slowest = time_constants(subject)
        if np.isfinite(slowest):
            found += f"; time constants {number(fastest)} to {number(slowest)} s (medians over X), of which the "
            found += f"fastest spans {number(fastest / dt)} samples and a motion {number(duration / slowest)} of the "
            found += "slowest"
        if duration < slowest < np.inf:
            verdict = "note"
            advice.append(f"motions end before the slow part has moved: take a duration of {5 * slowest:.1g} s")
    change = _change(subject)
    if np.isfinite(change):
        found += f"; y changes by {percent(change)} of its standard deviation from sample to sample"
        way = "" if system.discrete else f": take dt = {dt * SMOOTH / change:.1g} s"
        if change > JERKY:
            verdict = "problem" if change > COARSE else "note"
            advice.append(("the motion between samples is lost" if change > COARSE else "samples are few") + way)
        elif change < IDLE:
            verdict = "note"
            advice.append("samples tell hardly anything new" + way)
    yield Finding("sampling", verdict, found, "; ".join(advice))


def time_constants(subject: Subject) -> tuple[float, float]:
    """The fastest and the slowest time constant in seconds, medians over X; infinite where nothing changes."""
    sizes = np.abs(np.linalg.eigvals(subject.jacobian(subject.points["X"])))
    sizes = sizes[sizes.max(1) > 0]
    if not len(sizes):
        return np.inf, np.inf
    slow = np.where(sizes > ZERO * sizes.max(1, keepdims=True), sizes, np.inf).min(1)
    return float(1 / np.median(sizes.max(1))), float(1 / np.median(slow))


def _way_out(subject: Subject, x: np.ndarray, *, unstable: bool) -> str:
    """What to change so that motions stay that have been followed in wider bounds, (steps + 1, n, nx)."""
    system = subject.system
    if subject.policy:
        return "let the policy hold the system from all of X, widen the bounds, shrink X, or take a smaller dt"
    held = np.isfinite(x[-1]).all(-1)
    if held.mean() >= 1 - FEW:
        reached = np.array([x[:, held].min((0, 1)), x[:, held].max((0, 1))]).T
        widened = [
            f"of {name} to ({min(low, float(f'{ROOM * least:.2g}')):g}, {max(high, float(f'{ROOM * most:.2g}')):g})"
            for name, (low, high), (least, most) in zip(system.state_names, system.bounds, reached, strict=True)
            if least < low or most > high
        ]
        return "widen the bounds " + " and ".join(widened)
    way = f"they run away, also in bounds {WIDER:g} times as wide: shrink X"
    if not unstable:
        return way + ", or let it be, as training leaves them out"
    if not system.nu:
        return way
    try:
        stays = replace(subject, policy=named_policy(system, "controller")).stays
    except ValueError:  # there is no such controller, or a motion needs too many substeps
        stays = np.zeros(1, bool)
    if stays.mean() > MANY:
        return f"{way}, or train with --policy controller, under which {stays.sum()} of {len(stays)} stay"
    return f"{way}, or train under a policy of yours that holds the system: --policy script.py:function"


def _wider(system: System) -> System:
    low, high = np.array(system.bounds, dtype=float).T
    centre, half = (low + high) / 2, WIDER * (high - low) / 2
    kind = type(system)

    class Wider(kind):  # type: ignore[misc, valid-type]
        name: ClassVar[str] = f"{system.name}-wider"
        bounds: ClassVar[Box] = tuple(zip((centre - half).tolist(), (centre + half).tolist()))

    return Wider(**system.parameters)


def _change(subject: Subject) -> float:
    """Root mean square change of the outputs from sample to sample, in standard deviations; NaN if none moves."""
    y = subject.staying_outputs
    if not y.size:
        return np.nan
    spread, step = np.sqrt(y.var(0).mean(0)), np.sqrt((np.diff(y, axis=0) ** 2).mean((0, 1)))
    moving = spread > 0
    return float((step[moving] / spread[moving]).max()) if moving.any() else np.nan
