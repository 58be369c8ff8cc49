"""T_inv at given noise levels: estimates and their error covariances from the filter's state."""

import functools
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.inverse import InverseMap
from observers.machine import available


class Decoders:
    """T_inv for n entries ``outputs`` of the estimate; ``free_inverse``, if any, in rows without input since reset."""

    def __init__(self, artifact: Artifact, outputs: slice, **options: Any) -> None:
        free = artifact.free_inverse
        self.driven = Decoder(artifact.inverse, outputs, **options)
        self.free = None if free is None else Decoder(free, outputs, **options)

    def __call__(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Return the estimates (..., n) from filter states (..., size) and ages in seconds since reset."""
        return self._by_row(z, age, Decoder.__call__)

    def covariances(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Return the covariances of the estimates' errors, (..., nx, nx)."""
        return self._by_row(z, age, Decoder.covariance)

    def _by_row(self, z: np.ndarray, age: Any, of: Any) -> np.ndarray:
        driven, free = self.driven, self.free
        if free is None:
            return np.asarray(of(driven, z, age))
        nz = free.size  # z is [z_y, z_u], and z_u is exactly 0 until the first nonzero input
        moved = z[..., nz:].any(-1)
        if moved.all() or not moved.any():
            return np.asarray(of(driven, z, age) if moved.all() else of(free, z[..., :nz], age))
        ages = np.broadcast_to(age, moved.shape)
        of_driven, of_free = of(driven, z[moved], ages[moved]), of(free, z[~moved][:, :nz], ages[~moved])
        out = np.empty((*moved.shape, *of_driven.shape[1:]))
        out[moved], out[~moved] = of_driven, of_free
        return out


class Decoder:
    """T_inv at given noise levels: from z (..., size) and the age in seconds to n entries of the estimate (..., n)."""

    def __init__(
        self,
        inverse: InverseMap,
        outputs: slice,
        *,
        measurement_noise: float | tuple[float, ...],
        process_noise: float,
        compiled: bool | None = None,
    ) -> None:
        error = inverse.error_covariance
        self.error = None if error is None else error.at_level(inverse.shares(measurement_noise)[0])
        self._inverse = inverse = inverse.part(outputs)
        self.size = inverse.whiten.shape[1]
        self._whiten = np.ascontiguousarray((inverse.gain(measurement_noise)[:, None] * inverse.whiten).T)
        self._offset = -inverse.z_offset @ self._whiten
        self._conditions: list[Any] = [*inverse.noise_features(measurement_noise, process_noise)]
        self._needs_age = inverse.features[-1] == "age"
        self._machine = compiled is not False

    def __call__(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Return the estimate."""
        if z.ndim == 1 and self._machine and available():
            from observers.kernel_functions import decode_one

            x_hat = np.empty(len(self._inverse.x_offset))
            decode_one(z, float(age), self.network, x_hat)
            return x_hat
        inverse, conditions = self._inverse, self._conditions
        modes = z @ self._whiten
        modes += self._offset
        if self._needs_age:
            conditions = [*conditions, inverse.age_feature(age)]
        width = modes.shape[-1]
        inputs = np.empty((*modes.shape[:-1], width + len(conditions)), dtype=np.float32)
        inputs[..., :width] = modes
        for i, condition in enumerate(conditions):
            inputs[..., width + i] = condition
        return np.asarray(inverse.x_offset + inverse.x_scale * inverse.mlp(inputs))

    def covariance(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Return the covariance of the estimate's error, (..., nx, nx)."""
        assert self.error is not None
        return self.error(age, z.shape[:-1])

    @functools.cached_property
    def network(self) -> tuple[np.ndarray, ...]:
        """The network in the form that :func:`observers.kernel_functions.decode` takes.

        One matrix product in double precision whitens z and applies the first layer. In float32 the differences of
        nearly equal filter states would lose their digits.
        """
        inverse, modes = self._inverse, len(self._offset)
        weight, bias = (part.astype(float) for part in inverse.mlp.layers[0])
        given = modes + len(self._conditions)
        bias = bias + self._offset @ weight[:modes] + np.array(self._conditions, dtype=float) @ weight[modes:given]
        of_age = weight[given] if self._needs_age else np.zeros_like(bias)
        first = np.vstack([bias, of_age, self._whiten @ weight[:modes]])  # (2 + size, width of the layer)
        units = np.array([inverse.x_offset, inverse.x_scale], dtype=float)
        ages = np.array([inverse.age_unit, inverse.age_max if self._needs_age else 0.0], dtype=float)
        return first, units, ages, *inverse.mlp.packed(1)
