"""From the filter's state to T_inv's estimate, and to the covariance of its error, at given levels of noise."""

import functools
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.compiled import CompiledDecoder, available
from observers.inverse import InverseMap


class Decoders:
    """T_inv of driven and of free motion, some of their outputs; each row is decoded by the one that it needs."""

    def __init__(self, artifact: Artifact, outputs: slice, **options: Any) -> None:
        free = artifact.free_inverse
        self.driven = Decoder(artifact.inverse, outputs, **options)
        self.free = None if free is None else Decoder(free, outputs, **options)

    def __call__(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Return the estimates, (..., nx), of filter states (..., size) at ages in seconds."""
        return self._by_row(z, age, Decoder.__call__)

    def covariances(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Return the covariances of the estimates' errors, (..., nx, nx)."""
        return self._by_row(z, age, Decoder.covariance)

    def _by_row(self, z: np.ndarray, age: Any, of: Any) -> np.ndarray:
        driven, free = self.driven, self.free
        if free is None:
            return np.asarray(of(driven, z, age))
        nz = free.size  # behind it lies z_u, exactly 0 until an input acts
        moved = z[..., nz:].any(-1)
        if moved.all():
            return np.asarray(of(driven, z, age))
        if not moved.any():
            return np.asarray(of(free, z[..., :nz], age))
        ages = np.broadcast_to(age, moved.shape)
        of_driven, of_free = of(driven, z[moved], ages[moved]), of(free, z[~moved][:, :nz], ages[~moved])
        out = np.empty((*moved.shape, *of_driven.shape[1:]))
        out[moved], out[~moved] = of_driven, of_free
        return out


class Decoder:
    """T_inv at given levels of noise: z, (..., size), and the age in seconds to x_hat, (..., nx)."""

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
        self._needs_age, self._choice = inverse.features[-1] == "age", compiled

    def __call__(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Return the estimate."""
        machine = None if self._choice is False else self.compiled
        if machine is not None and z.ndim <= 2 and (z.ndim == 1 or machine.has_layers):
            return machine.single(z, float(age)) if z.ndim == 1 else machine.batch(z, age)
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

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "compiled"}  # made again where it goes

    @functools.cached_property
    def compiled(self) -> CompiledDecoder | None:
        """The same as machine code; None without Numba."""
        if not available():
            return None
        inverse = self._inverse
        return CompiledDecoder(
            inverse.mlp.layers,
            inverse.mlp.activation,
            whiten=self._whiten,
            offset=self._offset,
            conditions=self._conditions,
            age=(inverse.age_unit, inverse.age_max) if self._needs_age else None,
            x_offset=inverse.x_offset,
            x_scale=inverse.x_scale,
        )


__all__ = ["Decoder", "Decoders"]
