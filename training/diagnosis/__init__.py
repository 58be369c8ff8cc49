"""Whether a system, recorded data or an environment can be observed and learned: diagnosis before a training."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from kkl_gym.simulate import SubstepsError, check_duration, check_interval
from kkl_gym.system import System
from observers.checks import check_dt, noise_levels
from training.diagnosis import outputs, system
from training.diagnosis.finding import Finding, Verdict
from training.diagnosis.records import Judgement, Observability, observability, of_records
from training.diagnosis.system import Subject
from training.evaluation.levels import Level
from training.trajectories.policies import Controller

FIRST: dict[str, Callable[[System], Iterator[Finding]]] = {
    "system": system.declaration,
    "equations": system.equations,
}
THEN: dict[str, Callable[[Subject], Iterator[Finding]]] = {
    "compiled": system.machine_code,
    "inputs": system.inputs,
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
    """Find what would fail with a system in environments, training and evaluation."""
    for name, look in FIRST.items():
        findings = list(_guarded(name, look, of))
        yield from findings
        if any(finding.verdict == "problem" for finding in findings):
            yield Finding(name, "note", "all other checks are left out", "mend this first")
            return
    given = [of.measurement_noise] if measurement_noise is None else measurement_noise
    noise = tuple(level for one in given if np.any(level := noise_levels("measurement_noise", one, of.ny)))
    interval = of.dt if dt is None else check_dt(dt)
    subject = Subject(of, interval, of.duration if duration is None else duration, policy, noise)
    try:
        check_interval(of, interval)
        check_duration(subject.duration, interval)
        for name, look_at in THEN.items():
            yield from _guarded(name, look_at, subject)
    except SubstepsError as error:
        yield _problem("sampling", error)


def _guarded(name: str, look: Callable[[Any], Iterator[Finding]], at: System | Subject) -> Iterator[Finding]:
    """The findings of a check, and its exception as a problem."""
    try:
        yield from look(at)
    except SubstepsError:
        raise
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        yield _problem(name, error)


def _problem(name: str, error: Exception) -> Finding:
    text, _, advice = str(error).partition("; ")
    return Finding(name, "problem", text, advice)


__all__ = ["Finding", "Judgement", "Observability", "Verdict", "check", "observability", "of_records"]
