"""An observer to export: its artifact, the levels of noise that it assumes, and its origin."""

import dataclasses
import math
import os
import re
from dataclasses import dataclass
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

# Of the network, of samples and of estimates. The filter is of doubles in both: its modes are all but dependent, and
# what distinguishes them would be lost in the last digits of floats.
PRECISIONS = ("float", "double")
_MOST_SAMPLES = 2**32 - 1  # that C's unsigned long can count everywhere


@dataclass(frozen=True)
class Exported:
    """An observer as it leaves this package."""

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
        """Read an observer that is to be exported."""
        choice("precision", precision, PRECISIONS)
        text, path = os.fspath(name_or_path), resolve(name_or_path)
        artifact = Artifact.read(path)
        observer = KKLObserver(artifact, measurement_noise, process_noise=process_noise)
        return cls(
            artifact,
            name=identifier(path.stem if text.endswith(path.suffix) else text),
            source=path.name,
            checksum=checksum(path, ArtifactError),
            precision=precision,
            measurement_noise=observer.measurement_noise,
            process_noise=observer.process_noise,
        )

    @property
    def maps(self) -> dict[str, InverseMap]:
        """The inverse maps by their names: "driven", and where there is one "free", of motion without input."""
        free = self.artifact.free_inverse
        return {"driven": self.artifact.inverse} | ({} if free is None else {"free": free})

    @property
    def levels(self) -> tuple[float, ...]:
        """Assumed levels of measurement noise: none, one for all outputs, or one for each of several."""
        rows = {inverse.noise_gain.ndim == 2 for inverse in self.maps.values()}
        if True in rows:
            return tuple(np.broadcast_to(self.measurement_noise, self.artifact.ny).tolist())
        takes_level = any(
            "measurement_noise" in inverse.features or inverse.noise_gain.any() for inverse in self.maps.values()
        )
        return (float(np.max(self.measurement_noise)),) if takes_level else ()

    @property
    def needs_process_noise(self) -> bool:
        """Whether the step depends on the level of process noise."""
        return self.artifact.process_noise_max is not None or self.artifact.motion is not None

    @property
    def last_age(self) -> int:
        """Samples since the first after which the age no longer matters; 0 if it never does."""
        ends = [inverse.age_max for inverse in self.maps.values() if "age" in inverse.features]
        return min(math.ceil(max(ends, default=0.0) / self.artifact.filter.dt), _MOST_SAMPLES)

    @property
    def estimates(self) -> list[str]:
        """Names of the estimates: states, biases of outputs, then parameters."""
        artifact, system = self.artifact, SYSTEMS.get(self.artifact.system)
        bias = np.broadcast_to(artifact.training.get("bias", 0.0), artifact.ny)
        biases = [f"y{i + 1}_bias" for i in np.flatnonzero(bias)]
        states = list(system.state_names) if system else _numbered("x", artifact.nx - len(biases))
        return [*self._signals("hidden", [*states, *biases]), *artifact.estimated_parameters]

    @property
    def outputs(self) -> list[str]:
        """Names of the measured outputs."""
        return self._signals("measured", _numbered("y", self.artifact.ny))

    @property
    def inputs(self) -> list[str]:
        """Names of the known inputs."""
        return self._signals("inputs", _numbered("u", self.artifact.nu))

    def _signals(self, role: str, others: list[str]) -> list[str]:
        return others if self.artifact.signals is None else list(self.artifact.signals[role])

    @property
    def described(self) -> dict[str, Any]:
        """Metadata of exported files beside the numbers of a step, as JSON can hold them."""
        described: dict[str, Any] = {
            "name": self.name,
            "artifact": self.source,
            "sha256": self.checksum,
            "system": self.artifact.system,
            "parameters": dict(self.artifact.parameters),
            "dt": self.artifact.filter.dt,
            "y": self.outputs,
            "u": self.inputs,
            "x_hat": self.estimates,
        }
        if self.levels:
            described["measurement_noise"] = list(self.levels)
        if self.needs_process_noise:
            described["process_noise"] = self.process_noise
        return described


def output_expression(artifact: Artifact) -> Expression:
    """h(x)."""
    if artifact.h is not None:
        return artifact.h
    assert artifact.C is not None
    return Expression(
        [["+", 0.0, 0.0, *(["*", c, ["x", i]] for i, c in enumerate(row) if c)] for row in artifact.C.tolist()]
    )


def tracker_numbers(motion: Motion, dt: float) -> dict[str, Any]:
    """Weights of sigma points, and divergence detection."""
    watch = Supervision.of(motion, dt)
    weights = dict(zip(("middle", "middle_squares", "other"), sigma_weights(motion.nx), strict=True))
    others = {"trend_gain": watch.trend_gain, "inflation": INFLATION, "relinearisations": RELINEARISATIONS}
    return weights | others | dataclasses.asdict(watch)


def tracker_arrays(motion: Motion) -> dict[str, np.ndarray]:
    """Scaling of the states; bounds, and mean and covariance of where motions start, of scaled states."""
    low, high = ((bound - motion.x_offset) / motion.x_scale for bound in (motion.low, motion.high))
    mean = (motion.mean - motion.x_offset) / motion.x_scale
    covariance = motion.covariance / np.outer(motion.x_scale, motion.x_scale)
    scaling = {"x_offset": motion.x_offset, "x_scale": motion.x_scale}
    return scaling | {"low": low, "high": high, "start_mean": mean, "start_covariance": covariance}


def identifier(name: str) -> str:
    """Make an identifier of C of an observer's name: ``lorenz-spinn`` becomes ``lorenz_spinn``."""
    word = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    return word if word[:1].isalpha() else f"observer_{word}".rstrip("_")


def _numbered(letter: str, count: int) -> list[str]:
    return [letter] if count == 1 else [f"{letter}{i}" for i in range(1, count + 1)]
