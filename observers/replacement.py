"""Whether the maps of an observer can be replaced while its filter runs."""

from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.checks import shown
from observers.errors import ArtifactError


def check_replacement(artifact: Artifact, other: Artifact) -> None:
    """See that an artifact can take the place of another while the filter runs."""
    if not isinstance(other, Artifact):
        raise ArtifactError(f"an observer is replaced by an observers.Artifact, got {shown(other)}")
    there = _serves(other)
    for what, here in _serves(artifact).items():
        if here != there[what]:
            raise ArtifactError(
                f"the observer in use has {what} {shown(here)}, the other {shown(there[what])}: one that is to replace "
                "it may differ in its maps alone; make the wrapper anew"
            )
    for name in ("A", "B", "dt"):
        mine, others = (np.asarray(getattr(each.filter, name)) for each in (artifact, other))
        if mine.shape != others.shape or not np.allclose(mine, others, rtol=1e-9, atol=0.0):
            raise ArtifactError(
                f"the filters differ in {name}, so that the state of one means nothing to the other: train with the "
                "eigenvalues and dt of the observer in use, or make the wrapper anew"
            )


def _serves(artifact: Artifact) -> dict[str, Any]:
    """What an artifact is for, and what it estimates, by the words of messages."""
    signals, environment = artifact.signals, artifact.environment
    return {
        "environment": environment,
        "system": artifact.system if environment is None else None,
        "parameters": dict(artifact.parameters),
        "signals": None if signals is None else {role: tuple(names) for role, names in signals.items()},
        "estimated parameters": tuple(artifact.estimated_parameters),
        "number of states": artifact.nx,
        "number of inputs": artifact.nu,
    }
