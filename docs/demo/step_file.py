"""Convert an observer for ``kkl_observer.js``: ``python docs/demo/step_file.py MAP STEP.safetensors``."""

import os
import sys
from typing import Any

import numpy as np

from observers import storage
from observers.inverse import InverseMap
from observers.motion import Motion
from training.export.exported import Exported, tracker_arrays, tracker_numbers

KEY = "kkl_step"  # key in the metadata
_MAP_ARRAYS = ("z_offset", "whiten", "x_offset", "x_scale")
_MAP_SCALARS = ("process_noise_unit", "process_noise_max", "age_unit", "age_max")
_MOTION_ARRAYS = ("error", "process_noise", "least_measurement_noise")
_LIMIT_ARRAYS = ("levels", "mean", "low", "high")


def write_step(path: str | os.PathLike[str], exported: Exported) -> None:
    """Write the data of a step to a safetensors file: matrices of the filter at its dt, maps, motion, limits."""
    artifact, linear = exported.artifact, exported.artifact.filter
    nz = len(linear.A)
    tensors = {"transition": linear.transition[:nz, :nz]}
    tensors |= {name: getattr(linear, name)[:nz] for name in ("early_y", "late_y", "equilibrium")}
    if linear.nu:
        tensors["held_u"] = linear.held_u[nz : 2 * nz, 0]
    described = exported.metadata | {"maps": {}}
    for label, inverse in exported.maps.items():
        described["maps"][label] = _described_map(tensors, f"{label}.", inverse, artifact.ny)
        if (error := inverse.error_covariance) is not None:
            units = 1.0 if artifact.motion is None else np.outer(artifact.motion.x_scale, artifact.motion.x_scale)
            arrays = {"levels": error.levels, "ages": error.ages, "covariance": error.covariance / units}
            tensors |= {f"{label}.{name}": values for name, values in arrays.items()}
    if artifact.C is not None:
        tensors["C"] = np.asarray(artifact.C, dtype=float)
    if artifact.h is not None:
        described["h"] = artifact.h.components
    if artifact.motion is not None:
        described["motion"] = _described_motion(tensors, artifact.motion, linear.dt)
    if artifact.limits is not None:
        shape = artifact.limits.mean.shape
        tensors |= {f"limits.{name}": _by_output(getattr(artifact.limits, name), shape) for name in _LIMIT_ARRAYS}
        described["limits"] = {name: getattr(artifact.limits, name) for name in ("window", "warm_up")}
    storage.save(path, tensors, key=KEY, described=described)


def _by_output(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(values.reshape(len(values), -1), shape).copy()


def _described_map(tensors: dict[str, np.ndarray], prefix: str, inverse: InverseMap, ny: int) -> dict[str, Any]:
    """Add a map's arrays to ``tensors``; return its other settings."""
    tensors |= {f"{prefix}{name}": getattr(inverse, name) for name in _MAP_ARRAYS}
    tensors[f"{prefix}noise_gain"] = np.atleast_2d(inverse.noise_gain)
    storage.put_mlp(tensors, prefix, inverse.mlp)
    described: dict[str, Any] = {"activation": inverse.mlp.activation, "features": list(inverse.features)}
    for name in _MAP_SCALARS:
        value = getattr(inverse, name)
        if np.isfinite(value).all():  # JSON has no infinity
            described[name] = value
    described["measurement_noise_unit"] = np.atleast_1d(inverse.measurement_noise_unit).tolist()
    if "measurement_noise" in inverse.features:
        described["measurement_noise_max"] = np.broadcast_to(inverse.measurement_noise_max, ny).tolist()
    return described


def _described_motion(tensors: dict[str, np.ndarray], motion: Motion, dt: float) -> dict[str, Any]:
    """Add a motion's arrays to ``tensors``; return its other settings."""
    arrays = tracker_arrays(motion) | {name: getattr(motion, name) for name in _MOTION_ARRAYS}
    arrays |= {name: getattr(motion.factors, name) for name in ("levels", "ages")}
    arrays["factors"] = motion.factors.factors[[0, -1]].ravel()  # without process noise, and at its largest level
    described = tracker_numbers(motion, dt) | {"least_process_noise": motion.least_process_noise}
    if motion.equations is not None:
        described |= {"field": motion.equations.field.components, "substeps": motion.equations.substeps}
    if motion.flow is not None:
        storage.put_mlp(tensors, "motion.", motion.flow.mlp)
        arrays |= {name: getattr(motion.flow, name) for name in ("linear", "gain")}
        described |= {"activation": motion.flow.mlp.activation, "u_scale": motion.flow.u_scale.tolist()}
    tensors |= {f"motion.{name}": np.asarray(values, dtype=float) for name, values in arrays.items()}
    return described


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("usage: python docs/demo/step_file.py MAP STEP.safetensors")
    write_step(sys.argv[2], Exported.read(sys.argv[1]))
