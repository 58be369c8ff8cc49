"""An observer to export: its noise levels, the names of its signals, and its metadata."""

import os
import re
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kkl_gym.systems import SYSTEMS
from observers import Artifact, KKLObserver
from observers.checks import ArtifactError, choice
from observers.expression import Expression
from observers.inverse import InverseMap
from observers.motion import Motion
from observers.names import resolve
from observers.storage import checksum
from observers.tracker import INFLATION, RELINEARISATIONS, Supervision
from observers.unscented import weights as sigma_weights


@dataclass(frozen=True)
class Exported:
    """An observer to export, the precision of its networks and signals, and the noise levels that it assumes."""

    artifact: Artifact
    name: str
    source: str
    checksum: str
    precision: str
    measurement_noise: float | tuple[float, ...]
    process_noise: float

    @classmethod
    def read(
        cls,
        name_or_path: str | os.PathLike[str],
        *,
        precision: str = "float",
        measurement_noise: float | tuple[float, ...] | None = None,
        process_noise: float | None = None,
    ) -> "Exported":
        """Read a shipped observer or a file; the noise levels are as for :class:`observers.KKLObserver`."""
        choice("precision", precision, ("float", "double"))
        artifact = Artifact.read(path := resolve(name_or_path))
        observer = KKLObserver(artifact, measurement_noise, process_noise=process_noise)
        levels = observer.measurement_noise, observer.process_noise
        return cls(artifact, identifier(path.stem), path.name, checksum(path, ArtifactError), precision, *levels)

    @property
    def maps(self) -> dict[str, InverseMap]:
        """The inverse maps by name: "driven" and, if the artifact has one for motion without input, "free"."""
        maps = {"driven": self.artifact.inverse, "free": self.artifact.free_inverse}
        return {name: inverse for name, inverse in maps.items() if inverse is not None}

    @property
    def levels(self) -> tuple[float, ...]:
        """Levels of measurement noise: one for each output if T_inv takes several, else one for all outputs."""
        if self.artifact.inverse.noise_gain.ndim == 2:
            return tuple(np.broadcast_to(self.measurement_noise, self.artifact.ny).tolist())
        return (float(np.max(self.measurement_noise)),)

    @property
    def signals(self) -> dict[str, list[str]]:
        """Names of the outputs y, the inputs u, and the entries of x_hat: states, output biases, then parameters."""
        artifact, system = self.artifact, SYSTEMS.get(self.artifact.system)
        biases = np.flatnonzero(np.broadcast_to(artifact.training.get("bias", 0.0), artifact.ny))
        states = list(system.state_names) if system else _numbered("x", artifact.nx - len(biases))
        names = artifact.signals or {
            "measured": _numbered("y", artifact.ny),
            "inputs": _numbered("u", artifact.nu),
            "hidden": [*states, *(f"y{i + 1}_bias" for i in biases)],
        }
        y, u, x = (list(names[role]) for role in ("measured", "inputs", "hidden"))
        return {"y": y, "u": u, "x_hat": [*x, *artifact.estimated_parameters]}

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of the exported file, in types that JSON supports."""
        artifact = self.artifact
        metadata: dict[str, Any] = {"name": self.name, "artifact": self.source, "sha256": self.checksum}
        metadata |= {"system": artifact.system, "parameters": dict(artifact.parameters), "dt": artifact.filter.dt}
        return metadata | self.signals | {"measurement_noise": list(self.levels), "process_noise": self.process_noise}


def output_expression(artifact: Artifact) -> Expression | None:
    """Return the output h(x) as an expression, or None if the artifact does not hold it."""
    if artifact.C is None:
        return artifact.h
    rows = artifact.C.tolist()
    return Expression([["+", 0.0, 0.0, *(["*", c, ["x", i]] for i, c in enumerate(row) if c)] for row in rows])


def tracker_numbers(motion: Motion, dt: float) -> dict[str, Any]:
    """Return the weights of the sigma points, and the constants of relinearisation and of divergence detection."""
    watch = Supervision.of(motion, dt)
    weights = dict(zip(("middle", "middle_squares", "other"), sigma_weights(motion.nx), strict=True))
    others = {"trend_gain": watch.trend_gain, "inflation": INFLATION, "relinearisations": RELINEARISATIONS}
    return weights | others | asdict(watch)


def tracker_arrays(motion: Motion) -> dict[str, np.ndarray]:
    """Return the states' offset and scale, and the scaled states' bounds, initial mean and initial covariance."""
    low, high, mean = ((x - motion.x_offset) / motion.x_scale for x in (motion.low, motion.high, motion.mean))
    covariance = motion.covariance / np.outer(motion.x_scale, motion.x_scale)
    scaling = {"x_offset": motion.x_offset, "x_scale": motion.x_scale}
    return scaling | {"low": low, "high": high, "start_mean": mean, "start_covariance": covariance}


def identifier(name: str) -> str:
    """Make a C identifier from an observer's name: ``lorenz-spinn`` becomes ``lorenz_spinn``."""
    word = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    return word if word[:1].isalpha() else f"observer_{word}".rstrip("_")


def _numbered(letter: str, count: int) -> list[str]:
    return [letter] if count == 1 else [f"{letter}{i}" for i in range(1, count + 1)]
