"""The artifact: a whole observer in one file, with its filter, its maps, and the system for which it was trained."""

import functools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, NoReturn, get_args

import numpy as np

from observers import storage
from observers.checks import LARGEST, ArtifactError, is_finite, noise_levels, shown
from observers.expression import Expression
from observers.filter import LinearFilter
from observers.inverse import ForwardMap, InverseMap
from observers.monitor import Limits
from observers.motion import Motion
from observers.network import MLP

FORMAT = 1  # version of the file format
FAR = 10.0  # observers warn of inputs beyond this multiple of the largest input in training
USUAL_NOISE = 0.5  # default standard deviation of the measurement noise, in units of y
_KEY = "kkl-gym"


@dataclass(frozen=True)
class Artifact:
    """An observer as its file stores it. Raises ArtifactError if its parts are incompatible.

    Parameters
    ----------
    filter : LinearFilter
        The linear filter, with A, B, dt and the number of inputs.
    inverse : InverseMap
        T_inv, the map from the filter's state z to the state x.
    system : str
        Name of the system.
    parameters : mapping of str to float
        The system's physical parameters.
    forward : ForwardMap, optional
        T, the map from x to z, if it was learned.
    C : ndarray, shape (ny, nx), optional
        Matrix of a linear output h(x) = C x. The monitor, and predictions of missing outputs, need C or h.
    h : Expression, optional
        A nonlinear output h(x).
    limits : Limits, optional
        Limits of the residual y - h(x_hat) in normal operation, if they were calibrated.
    free_inverse : InverseMap, optional
        A map to x from z_y alone, the part of z that y drives; it replaces T_inv until the first nonzero input. Motion
        without input visits far fewer states than driven motion, so a map for these states alone is more accurate.
    motion : Motion, optional
        Model of the motion: the system's equations, or a network that predicts the next state. By default, an
        observer with a model tracks: T_inv starts a Kalman filter, which predicts by the model and corrects by samples.
    measurement_noise : float or tuple of float, length ny, default 0.5
        Default standard deviation of the noise on each sample, one for all outputs or one for each. The artifact limits
        it to the largest value in the maps' training.
    u_max : tuple of float, length nu, optional
        Largest absolute value of each input in training. Observers warn once of inputs beyond ten times this value.
    parameter_ranges : mapping of str to (float, float), optional
        (low, high) of each uncertain parameter: the observer was trained for systems with any parameters within these
        ranges.
    estimated_parameters : tuple of str, optional
        The uncertain parameters that T_inv estimates. They are its last outputs, in this order.
    training : mapping, optional
        Record of the training: its settings, seed and results.
    versions : mapping of str to str, optional
        Versions of the libraries that the training used.
    signals : mapping of str to sequence of str, optional
        For an observer that was learned from recorded states, without equations: the keys "measured" (y),
        "inputs" (u) and "hidden" (x), each with the names of its columns in the records.
    environment : mapping of str to object, optional
        For an observer that was learned from rollouts of an environment: the "id" of that environment and its arguments
        "kwargs". The observer fits only that environment. An observer from other records fits no environment.
    """

    filter: LinearFilter
    inverse: InverseMap
    system: str
    parameters: Mapping[str, float]
    forward: ForwardMap | None = None
    C: np.ndarray | None = None
    h: Expression | None = None
    limits: Limits | None = None
    free_inverse: InverseMap | None = None
    motion: Motion | None = None
    measurement_noise: float | tuple[float, ...] = USUAL_NOISE
    u_max: tuple[float, ...] | None = None
    parameter_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    estimated_parameters: tuple[str, ...] = ()
    training: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    signals: Mapping[str, Sequence[str]] | None = None
    environment: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.system, str):
            raise ArtifactError(f"the system's name must be a string, got {self.system!r}")
        for name in ("parameters", "parameter_ranges", "training", "versions"):
            if not isinstance(getattr(self, name), Mapping):
                raise ArtifactError(f"{name} must be a mapping, got {getattr(self, name)!r}")
        for name, value in self.parameters.items():
            if not is_finite(value):
                raise ArtifactError(f"the parameter {name} must be a finite number, got {value!r}")
        self._check_ranges()
        if self.inverse.whiten.shape[1] != self.filter.size or ("z_u" in self.inverse.features) != (self.filter.nu > 0):
            raise ArtifactError(
                f"T_inv has features {self.inverse.features} and takes {self.inverse.whiten.shape[1]} values of z, "
                f"but the filter has {self.filter.size} values of z and {self.filter.nu} inputs"
            )
        gain = self.inverse.noise_gain
        if gain.ndim == 2 and len(gain) != self.ny:
            raise ArtifactError(f"noise_gain must have one row for each of {self.ny} outputs, got {len(gain)} rows")
        usual = noise_levels("measurement_noise", self.measurement_noise, self.ny)
        object.__setattr__(self, "measurement_noise", self.inverse.within(usual))
        if self.u_max is not None and (len(self.u_max) != self.nu or not all(is_finite(each) for each in self.u_max)):
            raise ArtifactError(f"u_max must be {self.nu} finite numbers, got {shown(self.u_max)}")
        free, nz = self.free_inverse, len(self.filter.A)
        if free is not None:
            self._check_free(free)
        for error in (self.inverse.error_covariance, None if free is None else free.error_covariance):
            if error is not None and error.nx != self.nx:
                raise ArtifactError(f"error_covariance must have the observer's {self.nx} states, got {error.nx}")
        if self.forward is not None and (self.forward.mlp.inputs, self.forward.mlp.outputs) != (self.nx, nz):
            raise ArtifactError(
                f"T must map {self.nx} states to nz = {nz} values, got a map of {self.forward.mlp.inputs} states to "
                f"{self.forward.mlp.outputs} values"
            )
        if self.C is not None and self.C.shape != (self.ny, self.nx):
            raise ArtifactError(f"C must have shape {(self.ny, self.nx)}, got {self.C.shape}")
        if self.h is not None and (self.C is not None or len(self.h.components) != self.ny or self.h.states > self.nx):
            raise ArtifactError(
                f"h must have {self.ny} components and at most {self.nx} states, and C must be None; got "
                f"{len(self.h.components)} components, {self.h.states} states and C = {shown(self.C)}"
            )
        if self.motion is not None:
            self._check_motion(self.motion)
        if self.signals is not None:
            self._check_signals(self.signals)
        if self.environment is not None:
            self._check_environment(self.environment)
        if self.limits is not None and (not self.knows_output or self.limits.mean.shape[1] != self.ny):
            raise ArtifactError(f"limits need C or h, and must have {self.ny} outputs, got {self.limits.mean.shape[1]}")

    def require_system(self) -> None:
        """Raise ArtifactError if the observer was learned from recorded states, without equations of a system."""
        if self.signals is not None:
            names = {role: ", ".join(columns) for role, columns in self.signals.items()}
            given = " and ".join(columns for columns in (names["measured"], names["inputs"]) if columns)
            fits = "fits no environment" if self.environment is None else f"fits only {self.environment['id']}"
            raise ArtifactError(
                f"the observer {self.system!r} was learned from recorded states: it estimates {names['hidden']} from "
                f"{given}, sampled every {self.filter.dt:g} s. It has no equations, and {fits}; observers.load(path) "
                "runs it on samples"
            )

    def _check_free(self, free: InverseMap) -> None:
        nz = len(self.filter.A)
        if "z_u" in free.features or free.whiten.shape[1] != nz or not self.filter.nu:
            raise ArtifactError(f"free_inverse must take z_y alone, {nz} values, and the filter must have inputs")
        own = _conditions(self.inverse)
        if differing := [name for name, value in _conditions(free).items() if value != own[name]]:
            raise ArtifactError(f"inverse and free_inverse must agree, but differ in {', '.join(differing)}")

    def _check_motion(self, motion: Motion) -> None:
        sizes, ny = (motion.nx, len(motion.least_measurement_noise)), self.ny
        if sizes != (self.nx, ny) or not motion.fits_inputs(self.nu):
            raise ArtifactError(
                f"a model of {sizes[0]} states and {sizes[1]} outputs does not fit an observer of {self.nx} states "
                f"and {ny} outputs, or the model's inputs do not fit the observer's {self.nu} inputs"
            )
        if self.inverse.error_covariance is None or not self.knows_output:
            raise ArtifactError("a model of the motion needs T_inv's covariance and the output h(x), too")
        if self.parameter_ranges:
            raise ArtifactError(f"a model must have fixed parameters, not ranges of {', '.join(self.parameter_ranges)}")

    def _check_signals(self, signals: Mapping[str, Sequence[str]]) -> None:
        counts = {"measured": self.ny, "inputs": self.nu, "hidden": self.nx}
        if not isinstance(signals, Mapping) or set(signals) != set(counts):
            raise ArtifactError(f"signals must have the keys {', '.join(counts)}, got {shown(signals)}")
        for role, count in counts.items():
            names = signals[role]
            of_names = isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)
            if not of_names or len(names) != count:
                raise ArtifactError(f"signals[{role!r}] must be a list of {count} names, got {shown(names)}")

    def _check_environment(self, environment: Mapping[str, Any]) -> None:
        whole = isinstance(environment, Mapping) and set(environment) == {"id", "kwargs"}
        if not whole or not isinstance(environment["id"], str) or not isinstance(environment["kwargs"], Mapping):
            raise ArtifactError(f"environment must hold a string 'id' and a dict 'kwargs', got {shown(environment)}")
        if self.signals is None:
            raise ArtifactError(f"an artifact for the environment {environment['id']} needs signals, too")

    def _check_ranges(self) -> None:
        """Raise ArtifactError unless parameters are in range, estimated parameters have ranges, and nx is positive."""
        for name, ends in self.parameter_ranges.items():
            if not isinstance(ends, list | tuple) or len(ends) != 2 or not all(map(is_finite, ends)):
                raise ArtifactError(f"the range of the parameter {name} must be two finite numbers, got {shown(ends)}")
            if name not in self.parameters or not ends[0] <= self.parameters[name] <= ends[1]:
                raise ArtifactError(
                    f"the range {shown(tuple(ends))} must contain the parameter {name}, got {dict(self.parameters)}"
                )
        tuples = {name: tuple(ends) for name, ends in self.parameter_ranges.items()}  # files hold them as lists
        object.__setattr__(self, "parameter_ranges", tuples)
        if not {*self.estimated_parameters} <= {*self.parameter_ranges}:
            raise ArtifactError(
                f"estimated_parameters = {self.estimated_parameters} must be among the parameters with a range, "
                f"{tuple(self.parameter_ranges)}"
            )
        if self.nx < 1:
            raise ArtifactError(f"T_inv must estimate states, not only {len(self.estimated_parameters)} parameters")

    @functools.cached_property
    def nx(self) -> int:
        """Number of estimated states."""
        return len(self.inverse.x_offset) - len(self.estimated_parameters)

    @functools.cached_property
    def ny(self) -> int:
        """Number of outputs."""
        return int(self.filter.B.shape[1])

    @functools.cached_property
    def nu(self) -> int:
        """Number of inputs that the observer uses."""
        return self.filter.nu

    @functools.cached_property
    def usual_input(self) -> float:
        """The least of LARGEST and ten times each entry of ``u_max``, if given; inputs up to it pass all checks."""
        return min([LARGEST, *(FAR * each for each in self.u_max or ())])

    @property
    def knows_output(self) -> bool:
        """Whether the artifact holds h(x), as C or as h; :meth:`output` and :meth:`residual` need it."""
        return self.C is not None or self.h is not None

    def output(self, x: np.ndarray) -> np.ndarray:
        """Return h(x); NaN or infinite where h is undefined. Shapes: ``x`` (..., nx); returns (..., ny).

        Raises ArtifactError if the artifact holds neither C nor h.
        """
        if self.C is not None:
            return x @ self.C.T
        if self.h is None:
            raise ArtifactError(f"this artifact for {self.system!r} holds no output h(x)")
        return self.h(x)

    def residual(self, y: np.ndarray, x_hat: np.ndarray) -> np.ndarray:
        """Return y - h(x_hat), and 0 where h is undefined. Shapes and errors are those of :meth:`output`."""
        residual = y - self.output(x_hat)
        return residual if self.C is not None else np.where(np.isfinite(residual), residual, 0.0)

    def require_forward(self) -> ForwardMap:
        """Return T, or raise ArtifactError if the artifact has no T."""
        return self.forward or self._lacks(
            "holds no forward map T; the shipped maps SYSTEM-spinn hold one, and kkl-gym train SYSTEM "
            "--pipeline spinn makes one"
        )

    def require_known_start(self, *, tracking: bool) -> None:
        """Raise ArtifactError if an observer cannot start at a known state: it does not track, and there is no T."""
        if not tracking and self.forward is None:
            self._lacks(
                "cannot start at a known state: it has no T, and the observer does not track; kkl-gym train SYSTEM "
                "makes a map that tracks, and kkl-gym train SYSTEM --pipeline spinn a map with T"
            )

    def require_covariance(self) -> None:
        """Raise ArtifactError unless T_inv has a covariance."""
        if self.inverse.error_covariance is None:
            self._lacks("holds no covariance; kkl-gym train makes a map that does")

    def require_motion(self) -> Motion:
        """Return the model by which the observer predicts when it tracks, or raise ArtifactError without a model."""
        return self.motion or self._lacks("cannot track: it holds no model; kkl-gym train makes a map that tracks")

    def _lacks(self, text: str) -> NoReturn:
        raise ArtifactError(f"this map for {self.system!r} {text}")

    @property
    def process_noise_max(self) -> float | None:
        """The highest level of process noise in training; None if T_inv does not take the level as an input."""
        return self.inverse.process_noise_max if "process_noise" in self.inverse.features else None

    def check(self, system: str, parameters: Mapping[str, float], *, dt: float, ny: int, nu: int) -> None:
        """Raise ArtifactError unless the observer was made for this system; the message names the first difference.

        Parameters
        ----------
        system : str
            Name of the system.
        parameters : mapping of str to float
            The system's physical parameters; a parameter with a range may have any value within the range.
        dt : float
            Sampling interval in seconds.
        ny, nu : int
            Numbers of outputs and inputs. An observer without inputs fits a system with any number of inputs.
        """

        def differ(what: str, here: Any, there: Any) -> None:
            raise ArtifactError(
                f"the observer was made for {what} {here!r}, but the environment has {there!r}; change the "
                "environment, or train an observer for it (kkl-gym train) and pass its path; for a plant that differs "
                "on purpose, wrap the environment first, and then set env.unwrapped.system"
            )

        self.require_system()
        if self.system != system:
            differ("the system", self.system, system)
        for name in sorted({*self.parameters, *parameters}):
            here, there = self.parameters.get(name), parameters.get(name)
            if here is not None and there is not None:
                low, high = self.parameter_ranges.get(name, (here, here))
                if low - 1e-9 * abs(low) <= there <= high + 1e-9 * abs(high):
                    continue
            if name in self.parameter_ranges:
                differ(f"the parameter {name} within", self.parameter_ranges[name], there)
            differ(f"the parameter {name} =", here, there)
        if not math.isclose(self.filter.dt, dt, rel_tol=1e-9):
            differ("the sampling interval dt =", self.filter.dt, dt)
        for what, own, given in (("outputs", self.ny, ny), ("inputs", self.nu or nu, nu)):
            if own != given:
                differ(f"the number of {what}", own, given)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the artifact atomically: an interrupted write leaves ``path`` unchanged.

        Parameters
        ----------
        path : str or PathLike
            The file, whose name should end in ``.safetensors``. A missing folder is created.

        Raises
        ------
        OSError
            If the file cannot be written.
        TypeError, ValueError
            If JSON cannot represent a value, or the file would be too large.
        """
        tensors: dict[str, np.ndarray] = {}
        described = {"format": FORMAT, **_put(tensors, "", self)}
        storage.save(path, tensors, key=_KEY, described=described)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "Artifact":
        """Read an artifact.

        Parameters
        ----------
        path : str or PathLike
            The file.

        Returns
        -------
        Artifact
            The artifact that :meth:`save` wrote.

        Raises
        ------
        ArtifactError
            If the file is missing, unreadable, damaged, too large or of another format, or has no checksum or no
            observer.
        """
        tensors, described = storage.read(path, key=_KEY, error=ArtifactError, what="an observer")
        with storage.explained(path, ArtifactError):
            if (number := described.pop("format")) != FORMAT:
                raise ArtifactError(f"it has format {number!r}, kkl-gym reads {FORMAT}: train the observer again")
            for name, tensor in tensors.items():
                if not np.isfinite(tensor).all():
                    raise ArtifactError(f"its tensor {name} is not finite")
            artifact: Artifact = _get(cls, tensors, "", described)
            expected: dict[str, np.ndarray] = {}
            _put(expected, "", artifact)
            if unknown := sorted(tensors.keys() - expected.keys()):
                raise ArtifactError(f"unknown tensors: {', '.join(unknown)}")
        return artifact


def _conditions(inverse: InverseMap) -> dict[str, Any]:
    """Return the properties in which the two inverse maps of an artifact must agree."""
    process_noise = inverse.process_noise_unit, inverse.process_noise_max
    return {
        "number of estimated values": inverse.mlp.outputs,
        "measurement noise": inverse.measurement_noise_max,
        "process noise": process_noise if "process_noise" in inverse.features else None,
        "having a covariance": inverse.error_covariance is not None,
    }


def _put(tensors: dict[str, np.ndarray], prefix: str, part: Any) -> dict[str, Any]:
    """Add a part's arrays to ``tensors``, under names with a prefix, and return its other fields as nested dicts."""
    described: dict[str, Any] = {}
    for entry in fields(part):
        name, value = entry.name, getattr(part, entry.name)
        if isinstance(value, LinearFilter):
            tensors |= {"A": value.A, "B": value.B}
            described |= {"dt": value.dt, "inputs": value.nu}
        elif isinstance(value, MLP):
            storage.put_mlp(tensors, prefix, value)
            described["activation"] = value.activation
        elif isinstance(value, np.ndarray):
            tensors[f"{prefix}{name}"] = np.asarray(value, dtype=float)
        elif is_dataclass(value):
            described[name] = _put(tensors, f"{prefix}{name}.", value)
        elif isinstance(value, Mapping):
            described[name] = dict(value)
        elif value is not None and math.inf not in (value if isinstance(value, tuple) else (value,)):
            described[name] = value
    return described


def _get(kind: Any, tensors: Mapping[str, np.ndarray], prefix: str, described: Mapping[str, Any]) -> Any:
    """Return the part that :func:`_put` stored, or raise KeyError if an array or a field is missing."""
    left = dict(described)
    values: dict[str, Any] = {}
    for entry in fields(kind):
        name = entry.name
        if name == "filter":
            values[name] = LinearFilter(tensors["A"], tensors["B"], left.pop("dt"), left.pop("inputs"))
        elif name == "mlp":
            values[name] = storage.get_mlp(tensors, prefix, left.pop("activation"))
        elif f"{prefix}{name}" in tensors:
            values[name] = tensors[f"{prefix}{name}"]
        elif name in left and (part := next(filter(is_dataclass, (entry.type, *get_args(entry.type))), None)):
            values[name] = _get(part, tensors, f"{prefix}{name}.", left.pop(name))
        elif name in left:
            value = left.pop(name)
            values[name] = tuple(value) if isinstance(value, list) else value
        elif entry.default not in (None, math.inf):  # _put leaves out None and infinity
            raise KeyError(f"{prefix}{name}")
    if left:
        raise ArtifactError(f"unknown metadata keys: {', '.join(f'{prefix}{name}' for name in sorted(left))}")
    return kind(**values)
