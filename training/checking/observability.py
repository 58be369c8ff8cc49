"""What the outputs tell of the states: the default filter's spectrum, and the error that it leaves."""

from collections.abc import Iterator

import numpy as np

from kkl_gym import EquationError
from training.checking.finding import Finding, number, percent
from training.checking.subject import Subject
from training.neighbours import RESOLUTION
from training.presets import eigenvalues
from training.smoothness import intervals, smoothness
from training.spectrum import Spectrum
from training.tuning.probe import Probe

MOTIONS = 20  # that the prediction follows
UNTOLD, HARDLY = 0.9, 0.3  # of the standard deviation of a start that all of y leaves in some direction
INVOLVED = 0.3  # least component of a state in that direction
FORGOTTEN = 0.05  # of a start's standard deviation that is left at the end without y
VAGUE = 0.3  # error of a state without noise in its standard deviations


def spectrum(subject: Subject) -> Iterator[Finding]:
    """The default eigenvalues of an input-aware map."""
    chosen = eigenvalues(subject.system, subject.dt)
    slowest, fastest = -max(chosen), -min(chosen)
    yield Finding(
        "spectrum",
        "ok",
        f"{len(chosen)} real eigenvalues for each output, {number(-slowest)} to {number(-fastest)}/s by default, which "
        f"remember y for {number(1 / fastest)} to {number(1 / slowest)} s",
    )


def smooth(subject: Subject) -> Iterator[Finding]:
    """Whether an interval of real eigenvalues makes T smooth, for ``--pipeline spinn``."""
    system, dt = subject.system, subject.dt
    worst = 0.0
    for one in smoothness(system, intervals(system, dt, subject.duration), dt):
        chosen, worst = one.spectrum.eigenvalues, float(one.exponent.min())
        if one.smooth:
            found = f"T is smooth for the eigenvalues {chosen[0]:.3g} to {chosen[-1]:.3g}/s (exponent {worst:.2f})"
            yield Finding("spinn", "ok", found)
            return
    found = f"no interval of real eigenvalues makes T smooth; the last left an exponent of {worst:.2f}"
    yield Finding("spinn", "note", found, "take --pipeline input-aware, which learns no T")


def observability(subject: Subject) -> Iterator[Finding]:
    """The predicted error of each state, and states of which y tells nothing."""
    system = subject.system
    try:
        probe = Probe(system, subject.dt, subject.duration, motions=MOTIONS, step=subject.step, policy=subject.policy)
    except EquationError:
        found = "no error can be predicted where equations do not work on symbols"
        yield Finding("observability", "note", found, "write them in arithmetic and functions of kkl_gym.elementary")
        return
    except ValueError as error:
        motions = "under the policy" if subject.policy else "without input"
        found = f"no error can be predicted for motions {motions}: {error}"
        yield Finding("observability", "note", found, "mend first what is above")
        return
    unknown = untold(subject, probe)
    yield from unknown.values()
    default, noise = Spectrum(eigenvalues(system, subject.dt)), system.measurement_noise
    errors = [probe.error_of_states(default, 0.0), probe.error_of_states(default, noise)]
    errors.append(probe.error_of_states(None, noise))
    level = ", ".join(number(one) for one in np.atleast_1d(noise))
    for i, shares in enumerate((np.array(errors) / probe.x.std((0, 1))).T):
        if any(i in states for states in unknown):
            continue
        exact, noisy, least = map(percent, shares)
        found = f"{system.state_names[i]}: predicted error {exact} of its standard deviation without noise, "
        found += f"{noisy} at noise {level} (who knows the equations: {least})"
        vague = shares[0] > VAGUE
        advice = (
            f"let `kkl-gym tune` look for a better spectrum, with --dt {subject.dt:g} --duration {subject.duration:g}"
        )
        yield Finding("observability", "note" if vague else "ok", found, advice if vague else "")


def untold(subject: Subject, probe: Probe) -> dict[tuple[int, ...], Finding]:
    """What cannot be told from all of y, by the states that it is of."""
    system, found = subject.system, dict[tuple[int, ...], Finding]()
    without_y = np.linalg.norm(probe.Phi[-1] * subject.half, axis=-1).mean(0) / subject.half
    values, directions = np.linalg.eigh(
        probe.unknown_of_starts(tuple(RESOLUTION * size for size in system.output_range))
    )
    for share, direction in zip(np.sqrt(np.maximum(values, 0.0)), directions.T, strict=True):
        if share <= HARDLY:
            continue
        involved = np.flatnonzero(np.abs(direction) > INVOLVED)
        names = [system.state_names[i] for i in involved]
        text = f"y tells {'nothing' if share > UNTOLD else 'little'} of "
        text += names[0] if len(names) == 1 else f"a combination of {' and '.join(names)}"
        forgotten = (without_y[involved] < FORGOTTEN).all()
        found[tuple(involved.tolist())] = Finding(
            "observability",
            "problem" if share > UNTOLD and not forgotten else "note",
            f"{text} at the start" + (", which the motion forgets by itself" if forgotten else ""),
            f"let h measure {' or '.join(names)} too, or leave it out of the state",
        )
    return found
