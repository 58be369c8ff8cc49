"""Can this be observed, and learned? Checks of a system, of recorded data and of an environment, before a training."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from numpy.linalg import LinAlgError

from kkl_gym.simulate import SubstepsError, check_duration, check_interval
from kkl_gym.system import System
from observers.checks import check_dt
from training.diagnosis import equations, levels, motion, outputs
from training.diagnosis.finding import Finding, Verdict
from training.diagnosis.records import observability, of_records
from training.diagnosis.signals import Judgement, Observability
from training.diagnosis.subject import Subject
from training.evaluation.levels import Level
from training.trajectories.policies import Controller

FIRST: dict[str, Callable[[System], Iterator[Finding]]] = {
    "system": equations.declaration,
    "starts": equations.starts,
    "equations": equations.kinds_of_numbers,
}
THEN: dict[str, Callable[[Subject], Iterator[Finding]]] = {
    "compiled": equations.machine_code,
    "finite": equations.finite,
    "inputs": equations.inputs,
    "bounds": motion.bounds,
    "rate": motion.rate,
    "sampling": motion.sampling,
    "output": levels.outputs,
    "process noise": levels.process_noise,
    "observability": outputs.observability,
}


def check(
    system: System,
    *,
    dt: float | None = None,
    duration: float | None = None,
    policy: Controller | None = None,
    measurement_noise: Sequence[Level] | None = None,
) -> Iterator[Finding]:
    """Look for what would go wrong with a system in environments, training and evaluation."""
    for name, look in FIRST.items():
        findings = list(_guarded(name, look, system))
        yield from findings
        if any(finding.verdict == "problem" for finding in findings):
            yield Finding(name, "note", "all other checks are left out", "mend this first")
            return
    interval, noise = system.dt if dt is None else check_dt(dt), outputs.noise_of(system, measurement_noise)
    subject = Subject(system, interval, system.duration if duration is None else duration, policy, noise)
    try:
        check_interval(system, interval)
        check_duration(subject.duration, interval)
        for name, look_at in THEN.items():
            yield from _guarded(name, look_at, subject)
    except SubstepsError as error:
        yield _problem("sampling", error)


def _guarded(name: str, look: Callable[[Any], Iterator[Finding]], at: System | Subject) -> Iterator[Finding]:
    """What a check says, and what it raises as a problem."""
    try:
        yield from look(at)
    except SubstepsError:
        raise
    except (ValueError, ArithmeticError, LinAlgError) as error:
        yield _problem(name, error)


def _problem(name: str, error: Exception) -> Finding:
    found, _, advice = str(error).partition("; ")
    return Finding(name, "problem", found, advice)


__all__ = ["Finding", "Judgement", "Observability", "Verdict", "check", "observability", "of_records"]
