"""What the outputs of a system determine of its states: near each state by its equations, and globally by motions."""

import contextlib
from collections.abc import Iterator

import numpy as np

from training.diagnosis.finding import RESOLUTION, Finding, error, point
from training.diagnosis.records import AS_GOOD, ASKING, ASKING_SHARE, DETERMINED, Filtered, compare
from training.diagnosis.system import Subject
from training.evaluation.levels import show_level
from training.kalman import Belief, ExtendedKalmanFilter
from training.maps.coordinates import noise_covariance, settling_time
from training.presets import eigenvalues
from training.records import Record, Signals
from training.sources.recorded import split
from training.sources.simulated import unknown_start
from training.spectrum import Spectrum, smooth_spectrum

FOLLOWED, STEPS = 20, 2000  # motions that are followed, and samples of each
SHORTEST = 10  # samples
UNTOLD, HARDLY = 0.9, 0.3  # of the standard deviation of a start that all of y leaves in some direction
INVOLVED = 0.3  # least component of a state in that direction
VAGUE = 0.3  # error of a state without noise, in its standard deviations
LOCALLY, GLOBALLY = 0.1, 0.3  # errors: at most by the equations, and at least by neighbours, of a state with several y
OTHERS = 10_000  # samples, at most, among which neighbours are looked for
FAR, OFTEN = 1.0, 0.1  # standard deviations between states of like outputs, and how often they are so far apart


def observability(subject: Subject) -> Iterator[Finding]:
    """The least error of each state at some levels of noise, and states that y does not determine."""
    system = subject.system
    errors, left = least_errors(subject)
    unseen = _unseen(system.state_names, left)
    yield from unseen.values()
    exact, least = errors[0], _average(errors, round(subject.duration / subject.dt) + 1)
    torn = _torn(subject, least[0])
    yield from torn.values()
    for i, name in enumerate(system.state_names):
        if any(i in states for states in (*unseen, *torn)) or np.isnan(least[0, i]):
            continue
        first = int((exact[:, i] <= max(DETERMINED, AS_GOOD * exact[:, i].min())).argmax())
        shares = [f"{error(least[0, i])} without noise (seen {first * subject.dt:.3g} s after the start)"]
        shares += [f"{error(one[i])} at noise {show_level(level)}" for level, one in zip(subject.noise, least[1:])]
        found = f"{name}: at best an error of {', '.join(shares)}, in its standard deviations"
        vague = least[0, i] > VAGUE
        advice = f"let h measure more that depends on {name}" if vague else ""
        yield Finding("observability", "note" if vague else "ok", found, advice)


def least_errors(subject: Subject) -> tuple[np.ndarray, np.ndarray]:
    """Errors that a Kalman filter leaves which knows the equations and is linearised along the motions themselves.

    Returns root mean squares (levels, steps, nx) in the states' standard deviations along motions, without noise and at
    each level, and the covariance (nx, nx) at the end without noise, in units of the variances of the start.
    """
    system, levels = subject.system, (0.0, *subject.noise)
    x, u = subject.followed[0][: STEPS + 1, :FOLLOWED], subject.followed[1][:STEPS, :FOLLOWED]
    (length, n, _), start = x.shape, unknown_start(system)[1]
    if 2 * n < FOLLOWED:
        raise ValueError(
            f"only {n} motions from X stayed within the bounds; widen the bounds, shrink X or shorten the motions, or "
            "give a policy that holds the system (--policy)"
        )
    if length < SHORTEST:
        raise ValueError(
            f"motions of {subject.duration:g} s have only {length - 1} samples of {subject.dt:g} s; take a longer "
            "duration, or a smaller dt"
        )
    floor = [RESOLUTION * (size or 1.0) for size in system.output_range]  # of y without noise, as a network reads it
    R = np.repeat([np.diag(np.maximum(level, floor) ** 2) for level in levels], n, axis=0)
    filters = ExtendedKalmanFilter(system, subject.dt, Q=np.zeros_like(start), R=R)
    y, u = np.tile(system.output(x), (1, len(levels), 1)), np.tile(u, (1, len(levels), 1))
    rows = len(y[0])
    state = Belief(np.tile(x[0], (len(levels), 1)), np.tile(start, (rows, 1, 1)), np.zeros(rows, dtype=bool))
    square = np.empty((len(levels), length, system.nx))
    for k in range(length):
        state = filters.advance(state, y[k], u[k - 1])  # which ignores the input before the first sample
        square[:, k] = state.P.diagonal(axis1=1, axis2=2).reshape(len(levels), n, -1).mean(1)
    deviation = np.sqrt(start.diagonal())
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(square) / x.std((0, 1)), state.P[:n].mean(0) / np.multiply.outer(deviation, deviation)


def _average(errors: np.ndarray, steps: int) -> np.ndarray:
    """Mean of errors (levels, followed, nx) over a motion, whose rest is like the second half of its beginning."""
    weights = np.ones(errors.shape[1])
    late = weights[len(weights) // 2 :]
    late += max(0, steps - len(weights)) / len(late)
    return np.asarray(np.average(errors, axis=1, weights=weights))


def _unseen(names: tuple[str, ...], left: np.ndarray) -> dict[tuple[int, ...], Finding]:
    """Directions of the state of which y tells nothing or little, by the states involved."""
    found = dict[tuple[int, ...], Finding]()
    values, directions = np.linalg.eigh(left)
    for share, direction in zip(np.sqrt(np.maximum(values, 0.0)), directions.T, strict=True):
        if share > HARDLY:
            involved = np.flatnonzero(np.abs(direction) > INVOLVED)
            states = [names[i] for i in involved]
            of = states[0] if len(states) == 1 else f"a combination of {' and '.join(states)}"
            text, verdict = ("nothing", "problem") if share > UNTOLD else ("little", "note")
            found[tuple(involved.tolist())] = Finding(
                "observability",
                verdict,  # type: ignore[arg-type]
                f"y tells {text} of {of}",
                f"let h measure {' or '.join(states)} too, or leave it out of the state",
            )
    return found


def spectrum(subject: Subject) -> Iterator[Finding]:
    """The eigenvalues that a training takes, and those from which on T is smooth."""
    system, dt = subject.system, subject.dt
    taken = eigenvalues(system, dt)
    memory = settling_time(Spectrum(taken).filter(system.ny, dt))
    found = f"{len(taken)} eigenvalues of A for each output, {taken[0]:.3g} to {taken[-1]:.3g} 1/s, with which the "
    found += f"filter forgets its start in {memory:.3g} s"
    if not (system.discrete or subject.policy):
        with contextlib.suppress(ValueError):  # motions leave the bounds too soon
            found += f"; T is smooth for those beyond {smooth_spectrum(system, dt).eigenvalues[0]:.3g} 1/s"
    yield Finding("spectrum", "ok", found)


def _torn(subject: Subject, exact: np.ndarray) -> dict[tuple[int, ...], Finding]:
    """States that y determines near each state, but not which of several states it is, by a symmetry.

    Motions without input are compared as records are, by the state of a training's filter after its memory.
    """
    system = subject.system
    if subject.policy:
        return {}
    linear = Spectrum(eigenvalues(system, subject.dt)).filter(system.ny, subject.dt)
    x = subject.followed[0]
    t = subject.dt * np.arange(len(x))
    signals = Signals("t", tuple(f"y{i + 1}" for i in range(system.ny)), (), tuple(system.state_names))
    records = [
        Record(f"motion {i + 1}", t, system.output(each), x=each, signals=signals)
        for i, each in enumerate(np.moveaxis(x, 1, 0))
    ]
    window = min(int(np.ceil(settling_time(linear) / subject.dt)), len(x) // 2)
    rest, held_out = (Filtered(part, linear) for part in split(records, ASKING_SHARE, 0))
    others, one = rest.samples(window, OTHERS), held_out.samples(window, ASKING)
    covariance = noise_covariance(linear, np.array([window]))[0]
    compared = compare(one, others, covariance=covariance, noise=(0.0,), rng=np.random.default_rng(0))
    if compared is None:
        return {}
    candidates = (exact <= LOCALLY) & (compared.levels[0] >= GLOBALLY)
    near, distances = others.nearest(one.z)
    far = (np.abs(others.x[near] - one.x) / one.x.std(0) > FAR)[:, candidates].any(1)
    if not candidates.any() or far.mean() < OFTEN:
        return {}
    pair = int(np.where(far, distances, np.inf).argmin())
    names = ", ".join(name for name, here in zip(system.state_names, candidates) if here)
    states = f"{point(one.x[pair])} and {point(others.x[near[pair]])}"
    text = f"{names}: y tells them near each state, but not which of several states it is: {states} had nearly the "
    text += f"same y for {window * subject.dt:.3g} s, as by a symmetry"
    advice = "let h measure what the symmetry changes, or estimate what it leaves as it is"
    return {tuple(np.flatnonzero(candidates).tolist()): Finding("observability", "problem", text, advice)}
