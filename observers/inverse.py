"""T and T_inv: learned maps from the state to the filter's state and back."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from observers.checks import ArtifactError, check_shapes, is_finite
from observers.factors import ErrorCovariance
from observers.network import MLP

FEATURES = ("z_y", "z_u", "measurement_noise", "process_noise", "age")
_CONDITIONS = FEATURES[2:]  # the features that have a unit and a largest value


@dataclass(frozen=True)
class ForwardMap:
    """The learned map T: x -> z, T(x) = z_offset + z_scale * mlp((x - x_offset) / x_scale).

    Parameters
    ----------
    mlp : MLP
        The network, with nx inputs and nz outputs. Raises ArtifactError if the scaling does not fit it.
    x_offset, x_scale : ndarray, shape (nx,)
        Scaling of the states.
    z_offset, z_scale : ndarray, shape (nz,)
        Scaling of the filter's state.
    """

    mlp: MLP
    x_offset: np.ndarray
    x_scale: np.ndarray
    z_offset: np.ndarray
    z_scale: np.ndarray

    def __post_init__(self) -> None:
        nx, nz = self.mlp.inputs, self.mlp.outputs
        check_shapes(self, {"x_offset": (nx,), "x_scale": (nx,), "z_offset": (nz,), "z_scale": (nz,)})

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Evaluate T. Shapes: ``x`` (..., nx); returns (..., nz)."""
        z = self.mlp((np.asarray(x, dtype=float) - self.x_offset) / self.x_scale)
        return self.z_offset + self.z_scale * z


@dataclass(frozen=True)
class InverseMap:
    """T_inv: the map from the filter's state, the noise levels and the age to the state estimate.

    The network's inputs follow ``features``, in which "z_y" comes first and the others are optional:

    - ``z_y``, ``z_u``: together the modes, here the entries of ``whiten @ (z - z_offset)``, divided by
      1 + (sigma_v * noise_gain)^2, with sigma_v the standard deviation of the measurement noise. Each mode has unit
      variance over noise-free training data, so the division shrinks a noisy mode to its conditional mean;
    - ``measurement_noise``: log(1 + sigma_v / measurement_noise_unit), one input for each sigma_v (see below);
    - ``process_noise``: log(1 + min(level, process_noise_max) / process_noise_unit), with ``level`` the bound
      of the noise w in environments, in multiples of ``System.scale`` per second;
    - ``age``: log(1 + min(t, age_max) / age_unit) with t the time in seconds since the filter was reset.

    The output is x_offset + x_scale * mlp(inputs). Raises ArtifactError if the parts do not fit each other.

    A map for several outputs may take a sigma_v for each. ``noise_gain`` then has a row for each output, the squares
    (sigma_v * noise_gain)^2 are summed over outputs, and the unit and the largest value of sigma_v are tuples.

    Parameters
    ----------
    mlp : MLP
        The network.
    features : tuple of str
        An ordered selection of ``FEATURES``.
    z_offset : ndarray, shape (size,)
        Mean of the filter's state.
    whiten : ndarray, shape (modes, size)
        Matrix from the filter's state to the modes, which are the network's first inputs.
    noise_gain : ndarray, shape (modes,) or (ny, modes)
        Standard deviation of the noise in each mode, per unit of sigma_v: for all outputs together, or for each output.
    x_offset, x_scale : ndarray, shape (nx,)
        Scaling of the estimate; nx counts the estimated parameters, too.
    measurement_noise_unit : float or tuple of float, length ny, default 1
        Unit of sigma_v. If ``noise_gain`` has a row for each output, a number becomes a tuple.
    measurement_noise_max : float or tuple of float, length ny, default inf
        Largest sigma_v in training, in the same form. Without the feature ``measurement_noise``, any sigma_v is valid.
    process_noise_unit : float, default 1
        Unit of the process noise level.
    process_noise_max : float, default inf
        The highest level of process noise in training.
    age_unit : float, default 1
        Unit of the age in seconds.
    age_max : float, default 0
        Age in seconds beyond which estimates no longer depend on the age.
    error_covariance : ErrorCovariance, optional
        The covariance of the estimation error, if it was calibrated.
    """

    mlp: MLP
    features: tuple[str, ...]
    z_offset: np.ndarray
    whiten: np.ndarray
    noise_gain: np.ndarray
    x_offset: np.ndarray
    x_scale: np.ndarray
    measurement_noise_unit: float | tuple[float, ...] = 1.0
    measurement_noise_max: float | tuple[float, ...] = math.inf
    process_noise_unit: float = 1.0
    process_noise_max: float = math.inf
    age_unit: float = 1.0
    age_max: float = 0.0
    error_covariance: ErrorCovariance | None = None

    def __post_init__(self) -> None:
        if self.features != ("z_y", *(name for name in FEATURES[1:] if name in self.features)):
            raise ArtifactError(f"features must be z_y, then any of {FEATURES[1:]} in this order, got {self.features}")
        if self.whiten.ndim != 2:
            raise ArtifactError(f"whiten must have shape (modes, size), got {self.whiten.shape}")
        modes, size = self.whiten.shape
        outputs = len(self.noise_gain) if self.noise_gain.ndim == 2 else 1
        check_shapes(self, {"noise_gain": (outputs, modes) if outputs > 1 else (modes,)})
        for name in _CONDITIONS:
            for unit in self._each(f"{name}_unit"):
                if not is_finite(unit) or unit <= 0:
                    raise ArtifactError(f"{name}_unit must be a positive, finite number, got {unit!r}")
            for end in self._each(f"{name}_max"):
                if name in self.features and (not is_finite(end) or end <= 0):
                    raise ArtifactError(
                        f"{name}_max must be a positive, finite number for a map that takes {name}, got {end!r}"
                    )
                if end != math.inf and (not is_finite(end) or end < 0):
                    raise ArtifactError(f"{name}_max must be a nonnegative number, got {end!r}")
        conditions = sum(name in self.features for name in _CONDITIONS)
        if "measurement_noise" in self.features:
            conditions += outputs - 1
        if self.mlp.inputs != modes + conditions:
            raise ArtifactError(
                f"T_inv's network must have {modes} inputs for modes and {conditions} for noise levels and age, "
                f"got {self.mlp.inputs} inputs"
            )
        nx = self.mlp.outputs
        check_shapes(self, {"z_offset": (size,), "x_offset": (nx,), "x_scale": (nx,)})
        if self.error_covariance is not None and "measurement_noise" not in self.features:
            raise ArtifactError("error_covariance needs a map with the feature measurement_noise")

    def _each(self, name: str) -> tuple[Any, ...]:
        """Return a unit or largest value as a tuple: an entry for each row of noise_gain, or a single entry."""
        value = getattr(self, name)
        if self.noise_gain.ndim != 2 or not name.startswith("measurement_noise"):
            return (value,)
        if not isinstance(value, tuple):
            value = (value,) * len(self.noise_gain)
            object.__setattr__(self, name, value)
        if len(value) != len(self.noise_gain):
            raise ArtifactError(f"{name} = {value} does not fit a noise_gain of shape {self.noise_gain.shape}")
        return value

    def part(self, outputs: slice) -> "InverseMap":
        """Return a map to some entries of the estimate, without covariance, or this map if all are selected."""
        if range(self.mlp.outputs)[outputs] == range(self.mlp.outputs):
            return self
        x_offset, x_scale = self.x_offset[outputs], self.x_scale[outputs]
        return replace(self, mlp=self.mlp.part(outputs), x_offset=x_offset, x_scale=x_scale, error_covariance=None)

    def within(self, measurement_noise: float | tuple[float, ...]) -> float | tuple[float, ...]:
        """If the map takes noise levels, limit them to the largest in training, and return a float if all are equal.

        Raises ValueError for a tuple of levels if the map takes one level for all outputs.
        """
        if isinstance(measurement_noise, tuple) and self.noise_gain.ndim == 1 and self.noise_gain.any():
            raise ValueError(
                f"this map takes one level of measurement noise for all outputs, got {measurement_noise}: pass one "
                "number, or train again, which makes a map with a level for each output"
            )
        if "measurement_noise" not in self.features:
            return measurement_noise
        levels = np.minimum(measurement_noise, self.measurement_noise_max).tolist()
        return levels if isinstance(levels, float) else levels[0] if len({*levels}) == 1 else tuple(levels)

    def gain(self, measurement_noise: float | tuple[float, ...]) -> np.ndarray:
        """Return the factors (modes,) that shrink the modes at these standard deviations of the measurement noise."""
        sigma = np.reshape(measurement_noise, (-1, 1))
        return 1.0 / (1.0 + ((sigma * np.atleast_2d(self.noise_gain)) ** 2).sum(0))

    def shares(self, measurement_noise: float | tuple[float, ...], process_noise: float = 0.0) -> tuple[float, float]:
        """Return both noise levels in multiples of the largest in training; of several outputs the noisiest counts."""
        largest = np.max(np.divide(measurement_noise, self.measurement_noise_max))
        return float(largest), process_noise / self.process_noise_max

    def noise_features(self, measurement_noise: float | tuple[float, ...], process_noise: float) -> list[float]:
        """Return the network's inputs for noise levels, in the order of the features."""
        features = []
        if "measurement_noise" in self.features:
            features += np.atleast_1d(np.log1p(np.divide(measurement_noise, self.measurement_noise_unit))).tolist()
        if "process_noise" in self.features:
            features.append(math.log1p(min(process_noise, self.process_noise_max) / self.process_noise_unit))
        return features

    def age_feature(self, age: Any) -> Any:
        """Return the network's input for ``age``, a number or an array: the time since reset in seconds."""
        if isinstance(age, float):  # fast path for one sample
            return math.log1p(min(age, self.age_max) / self.age_unit)
        return np.log1p(np.minimum(age, self.age_max) / self.age_unit)
