"""Which states the outputs of a system determine: near each state by the equations, globally by simulated motions."""

import contextlib
from collections.abc import Iterator

import numpy as np

from training.diagnosis.finding import RESOLUTION, Finding, error
from training.diagnosis.records import AS_GOOD, DETERMINED, of_records
from training.diagnosis.system import Subject
from training.evaluation.levels import show_level
from training.kalman import ExtendedKalmanFilter
from training.presets import eigenvalues
from training.records import Record
from training.sources.simulated import unknown_start

FOLLOWED, MAX_STEPS = 20, 2000  # number of motions, and largest number of samples of each
MIN_STEPS = 10  # least number of samples of a motion
# A direction is a problem or a note if more than this share of its initial standard deviation remains after all of y.
UNSEEN, HARDLY = 0.9, 0.3
INVOLVED = 0.3  # a finding names the states with larger components in that direction
VAGUE = 0.3  # larger errors without noise, in standard deviations of the state, are noted
# A state has a symmetry if its error is at most LOCALLY by the equations, but at least GLOBALLY by neighbours in z.
LOCALLY, GLOBALLY = 0.1, 0.3


def observability(subject: Subject) -> Iterator[Finding]:
    """The least error of each state at each level of noise, and the states that y does not determine."""
    names = subject.system.state_names
    errors, left = least_errors(subject)
    weights = np.ones(errors.shape[1])  # steps beyond MAX_STEPS count as those of the second half
    late = weights[len(weights) // 2 :]
    late += max(0, round(subject.duration / subject.dt) + 1 - len(weights)) / len(late)
    least = np.average(errors, axis=1, weights=weights)
    findings = _unseen(names, left)
    findings |= _symmetries(subject, least[0])
    yield from findings.values()
    for i, name in enumerate(names):
        if any(i in states for states in findings) or np.isnan(least[0, i]):
            continue
        exact = errors[0, :, i]
        first = int((exact <= max(DETERMINED, AS_GOOD * exact.min())).argmax())
        shares = [f"{error(least[0, i])} without noise (determined after {first * subject.dt:.3g} s)"]
        shares += [f"{error(one[i])} at noise {show_level(level)}" for level, one in zip(subject.noise, least[1:])]
        text = f"{name}: at best an error of {', '.join(shares)}, in its standard deviations"
        if least[0, i] > VAGUE:
            yield Finding("observability", "note", text, f"let h measure another quantity that depends on {name}")
        else:
            yield Finding("observability", "ok", text)


def least_errors(subject: Subject) -> tuple[np.ndarray, np.ndarray]:
    """The posterior Cramér-Rao bound along motions, without process noise.

    Returns the bounds (levels, steps, nx) in standard deviations of the states along motions, the first level without
    noise, and the covariance (nx, nx) at the end without noise, relative to the variances of the start.
    """
    system, levels = subject.system, (0.0, *subject.noise)
    x, u = subject.followed[0][: MAX_STEPS + 1, :FOLLOWED], subject.followed[1][:MAX_STEPS, :FOLLOWED]
    (length, n, nx), start = x.shape, unknown_start(system)[1]
    if 2 * n < FOLLOWED:
        raise ValueError(
            f"only {n} motions from X stayed within the bounds; widen the bounds, shrink X or shorten the motions, or "
            "give a policy that holds the system (--policy)"
        )
    if length < MIN_STEPS:
        raise ValueError(
            f"motions of {subject.duration:g} s have only {length - 1} samples of {subject.dt:g} s; take a longer "
            "duration, or a smaller dt"
        )
    floor = [RESOLUTION * (size or 1.0) for size in system.output_range]  # no network reads y more accurately
    R = np.repeat([np.diag(np.maximum(level, floor) ** 2) for level in levels], n, axis=0)
    bound = ExtendedKalmanFilter(system, subject.dt, Q=np.zeros_like(start), R=R)
    _, P = bound.along(*(np.tile(each, (1, len(levels), 1)) for each in (system.output(x), u, x)))
    square = P.diagonal(axis1=2, axis2=3).reshape(length, len(levels), n, nx).mean(2).swapaxes(0, 1)
    deviation = np.sqrt(start.diagonal())
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(square) / x.std((0, 1)), P[-1, :n].mean(0) / np.multiply.outer(deviation, deviation)


def _unseen(names: tuple[str, ...], left: np.ndarray) -> dict[tuple[int, ...], Finding]:
    """Directions of the state that y determines hardly or not at all, by the states involved."""
    findings = dict[tuple[int, ...], Finding]()
    values, directions = np.linalg.eigh(left)
    for share, direction in zip(np.sqrt(np.maximum(values, 0.0)), directions.T, strict=True):
        if share > HARDLY:
            involved = np.flatnonzero(np.abs(direction) > INVOLVED)
            states = [names[i] for i in involved]
            of = states[0] if len(states) == 1 else f"a combination of {' and '.join(states)}"
            advice = f"let h measure {' or '.join(states)} too, or leave it out of the state"
            findings[tuple(involved.tolist())] = (
                Finding("observability", "problem", f"y does not determine {of}", advice)
                if share > UNSEEN
                else Finding("observability", "note", f"y hardly determines {of}", advice)
            )
    return findings


def spectrum(subject: Subject) -> Iterator[Finding]:
    """The eigenvalues of A that a training uses."""
    taken = eigenvalues(subject.system, subject.dt)
    text = f"{len(taken)} eigenvalues of A for each output, {taken[0]:.3g} to {taken[-1]:.3g} 1/s"
    yield Finding("spectrum", "ok", text)


def _symmetries(subject: Subject, exact: np.ndarray) -> dict[tuple[int, ...], Finding]:
    """States that y determines locally but not globally, as with a symmetry; motions without input serve as records."""
    system, x = subject.system, subject.followed[0]
    t = subject.dt * np.arange(len(x))
    records = [Record("motion", t, system.output(one), x=one) for one in np.moveaxis(x, 1, 0)]
    with contextlib.suppress(ValueError):  # the motions are too short, or an output never moves
        confused = (exact <= LOCALLY) & (of_records(records, measurement_noise=[]).errors[0].min(0) >= GLOBALLY)
        if confused.any() and not subject.policy:
            names = ", ".join(name for name, here in zip(system.state_names, confused) if here)
            text = f"{names}: y determines them near each state, but distant states have nearly the same y, as under a "
            advice = "let h measure what the symmetry changes, or estimate only what it leaves unchanged"
            found = Finding("observability", "problem", f"{text}symmetry", advice)
            return {tuple(np.flatnonzero(confused).tolist()): found}
    return {}
