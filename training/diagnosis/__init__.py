"""Diagnosis before a training: whether an observer for a system, records or an environment can be learned."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from kkl_gym.simulate import SubstepsError, check_duration, check_interval
from kkl_gym.system import System
from observers.checks import check_dt, noise_levels
from training.diagnosis import outputs, system
from training.diagnosis.finding import Finding, Verdict
from training.diagnosis.records import Judgement, Observability, observability, of_records
from training.diagnosis.system import Subject
from training.evaluation.levels import Level
from training.trajectories.motions import Controller

CHECKS: dict[str, Callable[[Subject], Iterator[Finding]]] = {
    "system": system.declaration,
    "equations": system.equations,
    # All checks below need equations that work.
    "compiled": system.machine_code,
    "bounds": system.bounds,
    "sampling": system.sampling,
    "output": system.outputs,
    "spectrum": outputs.spectrum,
    "observability": outputs.observability,
}


def check(
    of: System,
    *,
    dt: float | None = None,
    duration: float | None = None,
    policy: Controller | None = None,
    measurement_noise: Sequence[Level] | None = None,
) -> Iterator[Finding]:
    """Yield the findings of the checks: whether the system works in environments, training and evaluation."""
    equations = [finding for name in list(CHECKS)[:2] for finding in _findings(name, Subject(of, np.nan, np.nan))]
    yield from equations
    if any(finding.verdict == "problem" for finding in equations):
        yield Finding("equations", "note", "all other checks are left out", "correct the equations first")
        return
    given = [of.measurement_noise] if measurement_noise is None else measurement_noise
    noise = tuple(level for one in given if np.any(level := noise_levels("measurement_noise", one, of.ny)))
    interval, seconds = check_dt(of.dt if dt is None else dt), of.duration if duration is None else duration
    subject = Subject(of, interval, seconds, policy, noise)
    try:
        check_interval(of, interval)
        check_duration(seconds, interval)
        _ = subject.motions
    except (SubstepsError, ArithmeticError) as error:
        # Equations that are finite at the points of the first checks may still divide by zero along a motion.
        yield _problem("sampling", error)
        return
    for name in list(CHECKS)[2:]:
        yield from _findings(name, subject)


def _findings(name: str, subject: Subject) -> Iterator[Finding]:
    """Yield the findings of one check; an error that the check raises becomes a problem."""
    try:
        yield from CHECKS[name](subject)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        yield _problem(name, error)


def _problem(name: str, error: Exception) -> Finding:
    text, _, advice = str(error).partition("; ")
    return Finding(name, "problem", text, advice)


__all__ = ["Finding", "Judgement", "Observability", "Verdict", "check", "observability", "of_records"]
