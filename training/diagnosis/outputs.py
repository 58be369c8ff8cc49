"""What the outputs of a system determine of its states: near each state by its equations, and globally by motions."""

from collections.abc import Iterator, Sequence

import numpy as np

from kkl_gym.system import System
from observers.checks import noise_levels
from training.diagnosis.finding import Finding, error
from training.diagnosis.limits import Limits
from training.diagnosis.records import ASKING, ASKING_SHARE, Filtered, compare
from training.diagnosis.signals import AS_GOOD, DETERMINED
from training.diagnosis.subject import Subject
from training.evaluation.levels import Level, show_level
from training.maps.coordinates import noise_covariance, settling_time
from training.presets import eigenvalues
from training.records import Record, Signals
from training.sources.recorded import split
from training.spectrum import Spectrum

UNTOLD, HARDLY = 0.9, 0.3  # of the standard deviation of a start that all of y leaves in some direction
INVOLVED = 0.3  # least component of a state in that direction
FORGOTTEN = 0.05  # of a start's standard deviation that is left at the end without y
VAGUE = 0.3  # error of a state without noise, in its standard deviations
LOCALLY, GLOBALLY = 0.1, 0.3  # errors: at most by the equations, and at least by neighbours, of a state with several y
OTHERS = 10_000  # samples, at most, among which neighbours are looked for
FAR, OFTEN = 1.0, 0.1  # standard deviations between states of like outputs, and how often they are so far apart


def noise_of(system: System, given: Sequence[Level] | None) -> tuple[Level, ...]:
    """Levels of measurement noise beside none: those given, or the system's own."""
    levels = [system.measurement_noise] if given is None else given
    return tuple(one for level in levels if np.any(one := noise_levels("measurement_noise", level, system.ny)))


def observability(subject: Subject) -> Iterator[Finding]:
    """The least error of each state at some levels of noise, and states that y does not determine."""
    system = subject.system
    limits = Limits.of(subject)
    unseen = _unseen(limits)
    yield from unseen.values()
    exact = limits.errors(0.0)
    least = [limits.weights @ errors for errors in (exact, *map(limits.errors, subject.noise))]
    torn = _torn(limits, least[0])
    yield from torn.values()
    for i, name in enumerate(system.state_names):
        if any(i in states for states in (*unseen, *torn)) or np.isnan(least[0][i]):
            continue
        first = int((exact[:, i] <= max(DETERMINED, AS_GOOD * exact[:, i].min())).argmax())
        shares = [f"{error(least[0][i])} without noise (seen {limits.ages[first] * subject.dt:.3g} s after the start)"]
        shares += [f"{error(one[i])} at noise {show_level(level)}" for level, one in zip(subject.noise, least[1:])]
        found = f"{name}: at best an error of {', '.join(shares)}, in its standard deviations"
        vague = least[0][i] > VAGUE
        advice = f"let h measure more that depends on {name}" if vague else ""
        yield Finding("observability", "note" if vague else "ok", found, advice)


def _unseen(limits: Limits) -> dict[tuple[int, ...], Finding]:
    """What all of y does not determine to first order, by the states that it is of."""
    names, found = limits.subject.system.state_names, dict[tuple[int, ...], Finding]()
    without_y = np.linalg.norm(limits.Phi[-1], axis=-1).mean(0)
    values, directions = np.linalg.eigh(limits.unknown_of_starts(0.0))
    for share, direction in zip(np.sqrt(np.maximum(values, 0.0)), directions.T, strict=True):
        if share <= HARDLY:
            continue
        involved = np.flatnonzero(np.abs(direction) > INVOLVED)
        states = [names[i] for i in involved]
        text = f"y tells {'nothing' if share > UNTOLD else 'little'} of "
        text += states[0] if len(states) == 1 else f"a combination of {' and '.join(states)}"
        forgotten = (without_y[involved] < FORGOTTEN).all()
        found[tuple(involved.tolist())] = Finding(
            "observability",
            "problem" if share > UNTOLD and not forgotten else "note",
            f"{text} at the start" + (", which the motion forgets by itself" if forgotten else ""),
            f"let h measure {' or '.join(states)} too, or leave it out of the state",
        )
    return found


def _torn(limits: Limits, exact: np.ndarray) -> dict[tuple[int, ...], Finding]:
    """States that y determines near each state, but not which of several states it is, by a symmetry.

    Motions without input are compared as records are, by the state of a training's filter after its memory.
    """
    subject, system = limits.subject, limits.subject.system
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
    states = " and ".join(f"({', '.join(f'{value:.3g}' for value in x)})" for x in (one.x[pair], others.x[near[pair]]))
    text = f"{names}: y tells them near each state, but not which of several states it is: {states} had nearly the "
    text += f"same y for {window * subject.dt:.3g} s, as by a symmetry"
    advice = "let h measure what the symmetry changes, or estimate what it leaves as it is"
    return {tuple(np.flatnonzero(candidates).tolist()): Finding("observability", "problem", text, advice)}
