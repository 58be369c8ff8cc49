"""Whether a system is ready for training, and what to change: what ``kkl-gym check`` prints."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from numpy.linalg import LinAlgError

from kkl_gym.simulate import SubstepsError, check_duration, check_interval
from kkl_gym.system import System
from observers.checks import check_dt
from training.checking import dynamics, equations, levels, observability
from training.checking.finding import Finding, Verdict
from training.checking.subject import Subject
from training.trajectories.controllers import Controller

FIRST: dict[str, Callable[[System], Iterator[Finding]]] = {
    "system": equations.declaration,
    "starts": equations.starts,
    "equations": equations.kinds_of_numbers,
}
THEN: dict[str, Callable[[Subject], Iterator[Finding]]] = {
    "compiled": equations.machine_code,
    "finite": equations.finite,
    "inputs": equations.inputs,
    "rate": dynamics.rate,
    "speed": dynamics.speed,
    "bounds": dynamics.bounds,
    "sampling": dynamics.sampling,
    "output": levels.outputs,
    "target": levels.target,
    "process noise": levels.process_noise,
    "spectrum": observability.spectrum,
    "observability": observability.observability,
    "spinn": observability.smooth,
}


def check(
    system: System,
    *,
    dt: float | None = None,
    duration: float | None = None,
    policy: Controller | None = None,
    spinn: bool = False,
) -> Iterator[Finding]:
    """Look for what would go wrong with a system in environments, training and evaluation."""
    for name, look in FIRST.items():
        findings = list(_guarded(name, look, system))
        yield from findings
        if any(finding.verdict == "problem" for finding in findings):
            yield Finding(name, "note", "all other checks are left out", "mend this first")
            return
    interval = system.dt if dt is None else check_dt(dt)
    try:
        check_interval(system, interval)
    except SubstepsError as error:
        yield Finding("sampling", "problem", *str(error).split(": ", 1))
        return
    subject = Subject(system, interval, system.duration if duration is None else duration, policy)
    check_duration(subject.duration, interval)
    if duration is None:
        subject = replace(subject, duration=subject.affordable())
    for name, look_at in THEN.items():
        if name != "spinn" or spinn:
            yield from _guarded(name, look_at, subject)


def _guarded(name: str, look: Callable[[Any], Iterator[Finding]], at: System | Subject) -> Iterator[Finding]:
    """What a check says, and what it raises as a problem."""
    try:
        yield from look(at)
    except SubstepsError as error:
        found, _, advice = str(error).partition("; ")
        yield Finding(name, "problem", found, advice)
    except (ValueError, ArithmeticError, LinAlgError) as error:
        yield Finding(name, "problem", str(error))


__all__ = ["Finding", "Verdict", "check"]
