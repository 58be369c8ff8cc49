"""One file that holds a whole observer: filter, maps, scaling, and what they were made for."""

import json
import math
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from observers.filter import LinearFilter
from observers.monitor import Limits
from observers.network import MLP

FORMATS = (1, 2)  # the second has maps that are told the process noise; the others are still written as the first
FEATURES = ("z_y", "z_u", "measurement_noise", "process_noise", "age")
_KEY = "kkl-gym"
_LIMITS = ("levels", "mean", "low", "high")
# Scalars of an inverse map, and what the files call them.
_SCALARS = {
    "measurement_noise_unit": "noise_unit",
    "measurement_noise_max": "noise_max",
    "process_noise_unit": "process_unit",
    "process_noise_max": "process_max",
    "age_unit": "age_unit",
    "age_max": "age_max",
}
_INVERSE_ARRAYS = ("z_offset", "whiten", "noise_gain", "x_offset", "x_scale")
_LIMIT_SCALARS = ("window", "warm_up", "false_alarms", "duration")


class ArtifactError(ValueError):
    """A file is no artifact of ours, is damaged, or does not fit where it is used."""


@dataclass(frozen=True)
class ForwardMap:
    """T: x -> z as learned, T(x) = z_offset + z_scale * mlp((x - x_offset) / x_scale)."""

    mlp: MLP
    x_offset: np.ndarray
    x_scale: np.ndarray
    z_offset: np.ndarray
    z_scale: np.ndarray

    def __post_init__(self) -> None:
        sizes = (self.mlp.inputs,), (self.mlp.outputs,)
        if not sizes[0] == self.x_offset.shape == self.x_scale.shape:
            raise ArtifactError(f"a network of {self.mlp.inputs} inputs does not fit {self.x_offset.shape[-1]} states")
        if not sizes[1] == self.z_offset.shape == self.z_scale.shape:
            raise ArtifactError(f"a network of {self.mlp.outputs} outputs does not fit z of {self.z_offset.shape[-1]}")

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """States (..., nx) to z (..., nz)."""
        z = self.mlp((np.asarray(x, dtype=float) - self.x_offset) / self.x_scale)
        return self.z_offset + self.z_scale * z


@dataclass(frozen=True)
class InverseMap:
    """T_inv: the filter's state, and what else it is told, to the state estimate.

    The network's inputs are, in the order of ``features`` (of which "z_y" comes first and the rest may be missing):

    - ``z_y``, ``z_u``: together ``whiten @ (z - z_offset)``, divided by 1 + (sigma_v * noise_gain)^2: over the training
      data each has unit variance without measurement noise, so this shrinks it to its linear conditional mean;
    - ``measurement_noise``: log(1 + sigma_v / measurement_noise_unit);
    - ``process_noise``: log(1 + min(level, process_noise_max) / process_noise_unit), the level being that of the
      environments, a multiple of the system's scale per second;
    - ``age``: log(1 + min(t, age_max) / age_unit) with t the time in seconds since the filter was reset.

    The output is x_offset + x_scale * mlp(inputs).
    """

    mlp: MLP
    features: tuple[str, ...]
    z_offset: np.ndarray  # (size of the filter's state,)
    whiten: np.ndarray  # (modes, size)
    noise_gain: np.ndarray  # (modes,) standard deviation of each whitened mode per unit of sigma_v
    x_offset: np.ndarray  # (nx,)
    x_scale: np.ndarray  # (nx,)
    measurement_noise_unit: float = 1.0
    measurement_noise_max: float = math.inf  # the largest sigma_v in training; a map without the feature takes any
    process_noise_unit: float = 1.0
    process_noise_max: float = math.inf  # the highest level of process noise in training
    age_unit: float = 1.0
    age_max: float = 0.0

    def __post_init__(self) -> None:
        unknown = [name for name in self.features if name not in FEATURES]
        if unknown or self.features != tuple(name for name in FEATURES if name in self.features) or not self.features:
            raise ArtifactError(f"inverse features {self.features} are not an ordered selection of {FEATURES}")
        if self.features[0] != "z_y":
            raise ArtifactError(f"the first inverse feature must be z_y, got {self.features}")
        modes, size = self.whiten.shape
        if not (
            self.measurement_noise_unit > 0
            and self.age_unit > 0
            and self.process_noise_unit > 0
            and self.process_noise_max > 0
        ):
            raise ArtifactError("units of noise and age, and the highest level of process noise, must be positive")
        if "process_noise" in self.features and not math.isfinite(self.process_noise_max):
            raise ArtifactError(
                "a map that is told the process noise must say the highest level that it was trained for"
            )
        conditions = sum(name in self.features for name in ("measurement_noise", "process_noise", "age"))
        if self.mlp.inputs != modes + conditions or self.noise_gain.shape != (modes,) or self.z_offset.shape != (size,):
            raise ArtifactError(
                f"a network of {self.mlp.inputs} inputs does not fit {modes} modes and {conditions} conditions"
            )
        if not self.mlp.outputs == len(self.x_offset) == len(self.x_scale):
            raise ArtifactError(f"a network of {self.mlp.outputs} outputs does not fit {len(self.x_offset)} states")

    def gain(self, measurement_noise: float) -> np.ndarray:
        """What the whitened modes are multiplied with at this noise level, (modes,)."""
        return 1.0 / (1.0 + (measurement_noise * self.noise_gain) ** 2)

    def measurement_noise_feature(self, measurement_noise: Any) -> Any:
        """The network's input for a noise level."""
        return np.log1p(measurement_noise / self.measurement_noise_unit)

    def noise_features(self, measurement_noise: float, process_noise: float) -> list[float]:
        """What the network is told of noise, in order: of none, one or both."""
        told = []
        if "measurement_noise" in self.features:
            told.append(float(self.measurement_noise_feature(measurement_noise)))
        if "process_noise" in self.features:
            told.append(math.log1p(min(process_noise, self.process_noise_max) / self.process_noise_unit))
        return told

    def age_feature(self, age: Any) -> Any:
        """The network's input for a time since reset, in seconds."""
        if isinstance(age, float):  # a single step: numpy's own overhead would be felt
            return math.log1p(min(age, self.age_max) / self.age_unit)
        return np.log1p(np.minimum(age, self.age_max) / self.age_unit)


@dataclass(frozen=True)
class Artifact:
    """An observer as it is stored.

    filter : the linear filter with A, B, dt and the number of inputs.
    inverse : T_inv.
    system : name of the system.
    parameters : its physical parameters.
    forward : T, where one was learned.
    C : (ny, nx) where the output is linear, h(x) = C x: what coasting and monitoring need.
    limits : of the residual y - C x_hat in sound operation, where they were found.
    free_inverse : T_inv of z_y alone, in use as long as no input has acted since reset: motions without input keep to
        far fewer states than driven ones, which a map that knows of no input can rely on.
    training : how it was made: method, preset, configuration, seed, measures.
    versions : of the libraries that made it.
    """

    filter: LinearFilter
    inverse: InverseMap
    system: str
    parameters: Mapping[str, float]
    forward: ForwardMap | None = None
    C: np.ndarray | None = None
    limits: Limits | None = None
    free_inverse: InverseMap | None = None
    training: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.inverse.whiten.shape[1] != self.filter.size or ("z_u" in self.inverse.features) != (self.filter.nu > 0):
            raise ArtifactError(
                f"features {self.inverse.features} over {self.inverse.whiten.shape[1]} values do not fit "
                f"a filter of {self.filter.size} values and {self.filter.nu} inputs"
            )
        free, nz = self.free_inverse, len(self.filter.A)
        if free is not None and ("z_u" in free.features or free.whiten.shape[1] != nz or not self.filter.nu):
            raise ArtifactError(f"a map of free motion must be of z_y, {nz} values, beside one that knows of inputs")
        if free is not None and (
            len(free.x_offset) != self.nx or free.measurement_noise_max != self.inverse.measurement_noise_max
        ):
            raise ArtifactError("the maps of free and of driven motion differ in states, or in noise")
        if free is not None and _process(free) != _process(self.inverse):
            raise ArtifactError("the maps of free and of driven motion differ in what they are told of process noise")
        if self.C is not None and self.C.shape != (self.ny, self.nx):
            raise ArtifactError(f"C must have shape {(self.ny, self.nx)}, got {self.C.shape}")
        if self.limits is not None and (self.C is None or self.limits.mean.shape[1] != self.ny):
            raise ArtifactError(f"limits of {self.limits.mean.shape[1]} residuals need a C with as many outputs")

    @property
    def nx(self) -> int:
        """Number of states estimated."""
        return len(self.inverse.x_offset)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return int(self.filter.B.shape[1])

    @property
    def nu(self) -> int:
        """Number of inputs that the observer takes into account."""
        return self.filter.nu

    @property
    def process_noise_max(self) -> float | None:
        """The highest level of process noise that the map was trained for; None if it is not told the level."""
        found = _process(self.inverse)
        return None if found is None else found[1]

    def check(self, system: str, parameters: Mapping[str, float], *, dt: float, ny: int, nu: int) -> None:
        """Raise ArtifactError, naming both values, unless the observer was made for this system, dt and sizes."""

        def differ(what: str, here: Any, there: Any) -> None:
            raise ArtifactError(
                f"the observer was made for {what} {here!r}, but the environment has {there!r}; change the "
                "environment, or train an observer for it (kkl-gym train) and pass its path"
            )

        if self.system != system:
            differ("the system", self.system, system)
        for name in sorted({*self.parameters, *parameters}):
            here, there = self.parameters.get(name), parameters.get(name)
            if here is None or there is None or not math.isclose(here, there, rel_tol=1e-9, abs_tol=1e-12):
                differ(f"the parameter {name} =", here, there)
        if not math.isclose(self.filter.dt, dt, rel_tol=1e-9):
            differ("the sampling interval dt =", self.filter.dt, dt)
        if self.ny != ny:
            differ("the number of outputs", self.ny, ny)
        if self.nu not in (0, nu):
            differ("the number of inputs", self.nu, nu)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the artifact; the file appears whole or not at all."""
        tensors: dict[str, np.ndarray] = {"A": self.filter.A, "B": self.filter.B}
        if self.C is not None:
            tensors["C"] = np.ascontiguousarray(self.C, dtype=float)
        described = {"inverse": _put_inverse(tensors, "inverse", self.inverse)}
        if self.free_inverse is not None:
            described["free"] = _put_inverse(tensors, "free", self.free_inverse)
        meta: dict[str, Any] = {
            "format": FORMATS[0] if self.process_noise_max is None else FORMATS[1],
            "system": {"name": self.system, "parameters": dict(self.parameters)},
            "dt": self.filter.dt,
            "inputs": self.filter.nu,
            "holds": {"y": "first-order", "u": "zero-order"},
            **described,
            "training": dict(self.training),
            "versions": dict(self.versions),
        }
        if self.forward is not None:
            _put_mlp(tensors, "forward", self.forward.mlp)
            for name in ("x_offset", "x_scale", "z_offset", "z_scale"):
                tensors[f"forward.{name}"] = np.ascontiguousarray(getattr(self.forward, name), dtype=float)
            meta["forward"] = {"activation": self.forward.mlp.activation}
        if self.limits is not None:
            tensors |= {f"limits.{name}": np.ascontiguousarray(getattr(self.limits, name)) for name in _LIMITS}
            meta["limits"] = {name: getattr(self.limits, name) for name in _LIMIT_SCALARS}
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
        os.close(handle)
        try:
            save_file(tensors, temporary, metadata={_KEY: json.dumps(meta, sort_keys=True, allow_nan=False)})
            os.chmod(temporary, 0o644)
            os.replace(temporary, target)
        except BaseException:
            os.unlink(temporary)
            raise

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "Artifact":
        """Read an artifact; raises ArtifactError if the file is missing, damaged, foreign or of a newer format."""
        if not Path(path).is_file():
            raise ArtifactError(f"there is no file {path}")
        try:
            with safe_open(path, framework="numpy") as opened:
                text = (opened.metadata() or {}).get(_KEY)
                tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        except (SafetensorError, OSError, TypeError) as error:  # TypeError: a number type that NumPy lacks
            raise ArtifactError(f"{path} is damaged or no safetensors file: {error}") from error
        if text is None:
            raise ArtifactError(f"{path} was not written by kkl-gym: it carries no {_KEY!r} metadata")
        try:
            return cls._assemble(json.loads(text), tensors)
        except ArtifactError as error:
            raise ArtifactError(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise ArtifactError(f"{path} is incomplete: {error!r}") from error

    @classmethod
    def _assemble(cls, meta: Any, tensors: Mapping[str, np.ndarray]) -> "Artifact":
        if meta["format"] not in FORMATS:
            raise ArtifactError(f"it has format {meta['format']!r}, this version of kkl-gym reads {FORMATS}")
        for name, tensor in tensors.items():
            if not np.isfinite(tensor).all():
                raise ArtifactError(f"its tensor {name} is not finite")
        forward = None
        if "forward" in meta:
            forward = ForwardMap(
                mlp=_get_mlp(tensors, "forward", meta["forward"]["activation"]),
                **{name: tensors[f"forward.{name}"] for name in ("x_offset", "x_scale", "z_offset", "z_scale")},
            )
        return cls(
            filter=LinearFilter(tensors["A"], tensors["B"], meta["dt"], meta["inputs"]),
            inverse=_get_inverse(tensors, "inverse", meta["inverse"]),
            system=meta["system"]["name"],
            parameters=meta["system"]["parameters"],
            forward=forward,
            C=tensors.get("C"),
            limits=_get_limits(tensors, meta["limits"]) if "limits" in meta else None,
            free_inverse=_get_inverse(tensors, "free", meta["free"]) if "free" in meta else None,
            training=meta["training"],
            versions=meta["versions"],
        )


def _process(inverse: InverseMap) -> tuple[float, float] | None:
    """Unit and end of the levels of process noise that a map is told, if it is."""
    return (inverse.process_noise_unit, inverse.process_noise_max) if "process_noise" in inverse.features else None


def _put_inverse(tensors: dict[str, np.ndarray], prefix: str, inverse: InverseMap) -> dict[str, Any]:
    _put_mlp(tensors, prefix, inverse.mlp)
    for name in _INVERSE_ARRAYS:
        tensors[f"{prefix}.{name}"] = np.ascontiguousarray(getattr(inverse, name), dtype=float)
    names = [name for name in _SCALARS if _process(inverse) or not name.startswith("process")]
    scalars = {_SCALARS[name]: getattr(inverse, name) for name in names}
    return {
        "features": list(inverse.features),
        "activation": inverse.mlp.activation,
        **{name: value for name, value in scalars.items() if math.isfinite(value)},
    }


def _get_inverse(tensors: Mapping[str, np.ndarray], prefix: str, described: Mapping[str, Any]) -> InverseMap:
    unknown = set(described) - {"activation", "features", *_SCALARS.values()}
    if unknown:
        raise ArtifactError(f"its map {prefix} has settings that nobody knows: {', '.join(sorted(unknown))}")
    scalars = {name: described[key] for name, key in _SCALARS.items() if key in described}
    return InverseMap(
        mlp=_get_mlp(tensors, prefix, described["activation"]),
        features=tuple(described["features"]),
        **{**scalars, **{name: tensors[f"{prefix}.{name}"] for name in _INVERSE_ARRAYS}},
    )


def _put_mlp(tensors: dict[str, np.ndarray], prefix: str, mlp: MLP) -> None:
    for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        tensors[f"{prefix}.{i}.weight"] = np.ascontiguousarray(weight, dtype=np.float32)
        tensors[f"{prefix}.{i}.bias"] = np.ascontiguousarray(bias, dtype=np.float32)


def _get_limits(tensors: Mapping[str, np.ndarray], described: Mapping[str, float]) -> Limits:
    arrays = {name: tensors[f"limits.{name}"] for name in _LIMITS}
    scalars = {name: described[name] for name in _LIMIT_SCALARS}
    return Limits(**arrays, **scalars)  # type: ignore[arg-type]


def _get_mlp(tensors: Mapping[str, np.ndarray], prefix: str, activation: str) -> MLP:
    layers = sum(bool(re.fullmatch(rf"{prefix}\.\d+\.weight", name)) for name in tensors)
    weights = [tensors[f"{prefix}.{i}.weight"] for i in range(layers)]
    biases = [tensors[f"{prefix}.{i}.bias"] for i in range(layers)]
    return MLP(weights, biases, activation)


def shipped() -> dict[str, str]:
    """Names of the maps that ship with the package: ``{"van_der_pol": "van_der_pol-v1", ...}``.

    Every version that ever shipped is there under its full name; the name without a version is the newest.
    """
    versions: dict[str, list[int]] = {}
    for entry in files("observers").joinpath("maps").iterdir():
        match = re.fullmatch(r"(.+)-v(\d+)\.safetensors", entry.name)
        if match:
            versions.setdefault(match[1], []).append(int(match[2]))
    names = {}
    for name, numbers in sorted(versions.items()):
        names[name] = f"{name}-v{max(numbers)}"
        names.update({f"{name}-v{number}": f"{name}-v{number}" for number in numbers})
    return names


def resolve(name_or_path: str | os.PathLike[str]) -> Path:
    """The file behind a shipped name, or behind a path if it ends in ``.safetensors``."""
    text = os.fspath(name_or_path)
    if text.endswith(".safetensors"):
        return Path(text)
    names = shipped()
    if text not in names:
        raise ArtifactError(
            f"unknown observer {text!r}; shipped: {', '.join(names) or 'none'}; a file's name ends in .safetensors"
        )
    return Path(str(files("observers").joinpath("maps", f"{names[text]}.safetensors")))
