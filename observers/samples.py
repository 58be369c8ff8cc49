"""Checks of the values that users pass to an observer: arguments, other artifacts, samples, inputs and states."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from observers.artifact import FAR, Artifact
from observers.checks import LARGEST, ArtifactError, all_finite, flag, integer, is_finite, real_array, shown
from observers.machine import available

MAX_DELAY = 1000  # samples


def check_arguments(artifact: Artifact, monitor: bool, compiled: bool | None, tracking: bool | None) -> None:
    """Raise ValueError or ImportError unless an artifact supports these arguments of an observer."""
    if not isinstance(artifact, Artifact):
        raise ValueError(f"artifact must be an observers.Artifact, got {shown(artifact)}; observers.load takes names")
    if flag("monitor", monitor) and artifact.limits is None:
        parts = "limits" if artifact.knows_output else "limits and the output h(x), which this one lacks too"
        raise ValueError(
            f"this artifact for {artifact.system!r} holds no limits for a monitor; training.calibrate(artifact, "
            f"system) returns an artifact with {parts}"
        )
    if tracking is not None and flag("tracking", tracking):
        artifact.require_motion()
    elif tracking is not None and monitor and artifact.motion is not None:
        raise ValueError("this artifact has monitor limits only for an observer that tracks: leave tracking=False out")
    if compiled is not None and flag("compiled", compiled) and not available():
        raise ImportError("compiled=True needs Numba: pip install kkl-gym[fast], or leave compiled out")


def check_gate(artifact: Artifact, tracking: bool | None, gate: Any) -> float | None:
    """Return a gate as a float, or raise ValueError if it is invalid or the observer does not track."""
    if gate is None:
        return None
    if not is_finite(gate) or gate <= 0:
        raise ValueError(f"gate must be a positive number of standard deviations, got {shown(gate)}")
    _check_tracks(artifact, tracking)
    return float(gate)


def check_delay(artifact: Artifact, tracking: bool | None, delay: Any) -> int:
    """Return a delay as an int, or raise ValueError if it is invalid or the observer does not track."""
    if delay := integer("delay, in samples,", delay, 0, MAX_DELAY):
        _check_tracks(artifact, tracking)
    return delay


def _check_tracks(artifact: Artifact, tracking: bool | None) -> None:
    if tracking is not None and not tracking:
        raise ValueError(
            "a gate and a delay need an observer that tracks: leave out tracking=False, or a wrapper's estimate='z'"
        )
    artifact.require_motion()


def check_replacement(artifact: Artifact, other: Artifact) -> None:
    """Raise ArtifactError unless the artifact ``other`` can replace ``artifact`` while the filter runs."""
    if not isinstance(other, Artifact):
        raise ArtifactError(f"the replacement must be an observers.Artifact, got {shown(other)}")
    there = _shared(other)
    for what, here in _shared(artifact).items():
        if here != there[what]:
            raise ArtifactError(
                f"the observer in use has {what} {shown(here)}, the replacement {shown(there[what])}: both must "
                "agree; make a new observer or wrapper instead"
            )
    for name in ("A", "B", "dt"):
        mine, others = (np.asarray(getattr(each.filter, name)) for each in (artifact, other))
        if mine.shape != others.shape or not np.allclose(mine, others, rtol=1e-9, atol=0.0):
            raise ArtifactError(
                f"the filters differ in {name}, so the replacement cannot continue from the current state: train it "
                "with the eigenvalues and dt of the observer in use, or make a new observer or wrapper"
            )


def _shared(artifact: Artifact) -> dict[str, Any]:
    """Return the properties that a replacement must share, by their names in messages."""
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


def check_output(
    artifact: Artifact, y: np.ndarray, batch: tuple[int, ...], warn: Callable[[str], None] | None = None
) -> None:
    """Check outputs (..., ny). Without ``warn`` they are a first sample, in which no output may be missing."""
    if y.shape != (*batch, artifact.ny):
        raise ValueError(f"y must have shape {(*batch, artifact.ny)}, got {y.shape}")
    if all_finite(y):
        return
    if warn is None:
        _check_finite("y", y, hint="; outputs may be missing later, but the first sample must be complete")
    elif not artifact.knows_output:
        warn(f"the map for {artifact.system!r} holds no output h(x): a missing output keeps its last value")
    _check_finite("y", np.where(np.isnan(y), 0.0, y), hint="; NaN marks a missing output")


def held_input(
    artifact: Artifact, u: np.ndarray | None, batch: tuple[int, ...], warn: Callable[[str], None]
) -> np.ndarray:
    """Return inputs (..., nu) as floats, zeros for None; warn of inputs far beyond those in training."""
    nu = artifact.nu
    if u is None:
        return np.zeros((*batch, nu))
    u = real_array("u", u)
    if u.shape[:-1] != batch or (nu and u.shape != (*batch, nu)):
        raise ValueError(f"u must have shape {(*batch, nu)}, got {u.shape}")
    if nu == 0 and u.any():
        raise ValueError(
            f"this map for {artifact.system} takes no inputs, but u = {u}; use a map that takes inputs, "
            "or pass u=None to ignore them"
        )
    if not all_finite(u, artifact.usual_input):  # smaller inputs need neither of the checks below
        _check_finite("u", u)
        most = np.array(artifact.u_max)
        if (far := np.abs(u) > FAR * most).any():
            text = ", ".join(f"{each:g}" for each in most)
            warn(f"an input of {u[far][0]:g} is far beyond those in training, at most {text}: estimates may be wrong")
    return u if nu else u[..., :0]


def first_state(artifact: Artifact, tracking: bool, y0: np.ndarray, x0: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Return the filter's state (..., size) and age at the first sample ``y0``, from ``x0`` (..., nx) if given."""
    if x0 is None:
        return artifact.filter.start(y0), 0
    artifact.require_known_start(tracking=tracking)
    x0, shape = real_array("x0", x0), (*y0.shape[:-1], artifact.nx)
    if x0.shape != shape:
        raise ValueError(f"x0 must have shape {shape}, got {x0.shape}")
    _check_finite("x0", x0, hint="; leave x0 out where it is unknown")
    if artifact.forward is None:  # only the tracker starts at x0
        return artifact.filter.start(y0), 0
    z0 = np.zeros((*shape[:-1], artifact.filter.size))
    z0[..., : artifact.forward.mlp.outputs] = artifact.forward(x0)
    return z0, math.inf  # the age of a filter without transient; maps limit it to their age_max


def recorded_inputs(u: np.ndarray | None, steps: int) -> np.ndarray | None:
    """Return the inputs (steps - 1, ..., nu) between samples, without any input after the last sample."""
    if u is None:
        return None
    u = real_array("u", u)
    if u.ndim < 1 or len(u) not in (steps - 1, steps):
        raise ValueError(f"u must have {steps - 1} or {steps} rows for {steps} rows of y, got shape {u.shape}")
    return u[: steps - 1]


def intervals(t: np.ndarray, steps: int) -> np.ndarray:
    """Return the intervals (steps - 1,) between times (steps,) in seconds."""
    t = real_array("t", t)
    if t.shape != (steps,) or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise ValueError(f"t must be {steps} increasing times in seconds, got {shown(t)}")
    return np.diff(t)


def _check_finite(name: str, values: np.ndarray, *, hint: str = "") -> None:
    """Raise a ValueError that names the first entry that is too large or not finite."""
    if not all_finite(values):
        at = tuple(np.argwhere(~(np.abs(values) <= LARGEST))[0].tolist())
        entry = f"{name}[{', '.join(map(str, at))}] = {values[at]}"
        raise ValueError(f"{name} holds NaN, infinity or values beyond 1e15: {entry}{hint}")
