"""The step as a file of constants, which ``kkl_observer.js`` runs in browsers and in Node."""

import dataclasses
import os
from importlib.resources import files
from typing import Any

import numpy as np

from observers import storage
from observers.flow import Flow
from observers.inverse import InverseMap
from observers.polynomial import table
from observers.supervision import INFLATION, Supervision
from training.export.exported import Exported

KEY = "kkl_step"  # of the metadata
_MAP_ARRAYS = ("z_offset", "whiten", "noise_gain", "x_offset", "x_scale")
_MAP_SCALARS = tuple(
    f"{name}_{end}" for name in ("measurement_noise", "process_noise", "age") for end in ("unit", "max")
)
_FLOW_ARRAYS = ("x_offset", "x_scale", "u_scale", "gain", "polynomial", "error", "process_noise")
_LIMIT_ARRAYS = ("levels", "mean", "low", "high")


def javascript() -> str:
    """The module ``kkl_observer.js``, the same for every observer."""
    return files("training.export").joinpath("kkl_observer.js").read_text(encoding="utf-8")


def write_step(path: str | os.PathLike[str], exported: Exported) -> None:
    """Write what a step needs to a safetensors file: matrices of the filter at its dt, maps, limits of the monitor."""
    exported.refuse_nonlinear("JavaScript")
    artifact, linear = exported.artifact, exported.artifact.filter
    nz = len(linear.A)
    block = linear.transition[:nz, :nz]
    at = np.argwhere(block - np.diag(block.diagonal()))
    tensors = {"diagonal": block.diagonal()}
    tensors |= {name: getattr(linear, name)[:nz] for name in ("early_y", "late_y", "equilibrium")}
    if len(at):
        tensors |= {"mixing": block[tuple(at.T)], "mixing_at": at.astype(float)}
    if linear.nu:
        tensors["held_u"] = linear.held_u[nz : 2 * nz, 0]
    described = exported.described | {"maps": {}}
    for label, inverse in exported.maps.items():
        described["maps"][label] = _described_map(tensors, f"{label}.", inverse)
    if artifact.flow is not None:
        described["flow"] = _described_flow(tensors, artifact.flow, linear.dt)
    if artifact.C is not None:
        tensors["C"] = np.asarray(artifact.C, dtype=float)
    if artifact.limits is not None:
        tensors |= {f"limits.{name}": getattr(artifact.limits, name) for name in _LIMIT_ARRAYS}
        described["limits"] = {name: getattr(artifact.limits, name) for name in ("window", "warm_up")}
    storage.save(path, tensors, key=KEY, described=described)


def _described_map(tensors: dict[str, np.ndarray], prefix: str, inverse: InverseMap) -> dict[str, Any]:
    """Add a map's arrays; returns what else there is to say of it."""
    tensors |= {f"{prefix}{name}": getattr(inverse, name) for name in _MAP_ARRAYS}
    storage.put_mlp(tensors, prefix, inverse.mlp)
    described: dict[str, Any] = {"activation": inverse.mlp.activation, "features": list(inverse.features)}
    for name in _MAP_SCALARS:
        value = getattr(inverse, name)
        if np.isfinite(value).all():  # JSON knows no infinity
            described[name] = value
    if inverse.spread is not None:
        storage.put_mlp(tensors, f"{prefix}spread.", inverse.spread.in_units(inverse.x_scale))
        tensors |= {f"{prefix}spread.{name}": getattr(inverse.spread, name) for name in ("levels", "ages", "factors")}
        described["spread"] = {"activation": inverse.spread.mlp.activation}
    return described


def _described_flow(tensors: dict[str, np.ndarray], flow: Flow, dt: float) -> dict[str, Any]:
    """Add a flow's arrays, with bounds of scaled states; returns what else there is to say of it."""
    storage.put_mlp(tensors, "flow.", flow.mlp)
    arrays = {name: getattr(flow, name) for name in _FLOW_ARRAYS}
    arrays["low"], arrays["high"] = flow.scaled_bounds
    if flow.bend is not None:
        arrays["bend"] = flow.bend
    arrays["least_measurement_noise"] = flow.least_measurement_noise
    arrays["earlier"], arrays["by"] = table(flow.nx + flow.nu, flow.degree)
    for kind, factors in (("factors", flow.factors), ("free_factors", flow.free_factors)):
        if factors is not None:
            doubt = np.zeros_like(factors.factors) if factors.doubt is None else factors.doubt
            of_kind = {"levels": factors.levels, "ages": factors.ages, "factors": factors.factors, "doubt": doubt}
            arrays |= {f"{kind}.{name}": values for name, values in of_kind.items()}
    tensors |= {f"flow.{name}": np.asarray(values, dtype=float) for name, values in arrays.items() if values.size}
    watch = Supervision.of(flow, dt)
    return {
        "activation": flow.mlp.activation,
        "least_process_noise": flow.least_process_noise,
        **dataclasses.asdict(watch),
        "trend_gain": watch.trend_gain,
        "inflation": INFLATION,
    }
