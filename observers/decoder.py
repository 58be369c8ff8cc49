"""From the filter's state to the estimate, and to the covariance of what that is off by, at given levels of noise."""

import functools
from typing import Any, Self

import numpy as np

from observers.artifact import Artifact
from observers.compiled import CompiledDecoder
from observers.inverse import InverseMap
from observers.sparse import MANY_ROWS
from observers.spread import Covariance

# Which decoder is asked, in which rows (None for all), what its networks are given, and the age in seconds.
Read = list[tuple["Decoder", np.ndarray | None, np.ndarray, Any]]


class Decoders:
    """The map of driven motion and, where there is one, that of free motion: each is asked where it holds."""

    def __init__(self, driven: "Decoder", free: "Decoder | None") -> None:
        self._driven, self._free = driven, free

    @classmethod
    def of(
        cls,
        artifact: Artifact,
        outputs: slice,
        *,
        measurement_noise: float | tuple[float, ...],
        process_noise: float,
        compiled: bool = False,
    ) -> Self:
        """Those of an artifact at levels of noise, for some of the maps' outputs; single samples compiled or not."""
        driven, free = (
            None
            if inverse is None
            else Decoder(inverse.part(outputs), measurement_noise, process_noise, compiled=compiled)
            for inverse in (artifact.inverse, artifact.free_inverse)
        )
        assert driven is not None
        return cls(driven, free)

    def __call__(self, z: np.ndarray, age: Any) -> np.ndarray:
        """The estimates, (..., nx)."""
        return self.estimate(z, age)[1]

    def covariances(self, z: np.ndarray, age: Any) -> np.ndarray:
        """Of what the estimates are off by, (..., nx, nx)."""
        return self.covariance(self.read(z, age))

    def estimate(self, z: np.ndarray, age: Any) -> tuple[Read | None, np.ndarray]:
        """The estimates, and what the networks are given where nobody has compiled it away."""
        parts = self._parts(z, age)
        if len(parts) == 1:  # most often
            decoder, _, z, age = parts[0]
            x_hat = decoder.compiled(z, age)
            if x_hat is not None:
                return None, x_hat
        else:
            found = [decoder.compiled(z, age) for decoder, _, z, age in parts]
            whole = [x_hat for x_hat in found if x_hat is not None]
            if len(whole) == len(parts):
                return None, _in_place(parts, whole)
        read = [(decoder, rows, decoder.read(z, age), age) for decoder, rows, z, age in parts]
        return read, self.mean(read)

    def read(self, z: np.ndarray, age: Any) -> Read:
        """What the networks are given for filter states, (..., size), of these ages in seconds."""
        return [(decoder, rows, decoder.read(z, age), age) for decoder, rows, z, age in self._parts(z, age)]

    def _parts(self, z: np.ndarray, age: Any) -> Read:
        """Which decoder is asked in which rows, with the filter states there in place of what networks are given."""
        driven, free = self._driven, self._free
        if free is None:
            return [(driven, None, z, age)]
        nz = free.size  # behind it lies z_u, exactly 0 until an input acts
        if z.ndim == 1:  # a single sample: every call of numpy would be felt
            if z[-1] or any(z[nz:].tolist()):
                return [(driven, None, z, age)]
            return [(free, None, z[:nz], age)]
        moved = z[..., -1] != 0  # most often
        moved = moved if moved.all() else np.asarray(z[..., nz:].any(-1))
        if moved.all():
            return [(driven, None, z, age)]
        if not moved.any():
            return [(free, None, z[..., :nz], age)]
        age, still = np.broadcast_to(age, moved.shape), ~moved
        return [
            (driven, moved, z[moved], age[moved]),
            (free, still, z[still][:, :nz], age[still]),
        ]

    def mean(self, read: Read) -> np.ndarray:
        """The estimates, (..., nx)."""
        return _in_place(read, [decoder.mean(inputs) for decoder, _, inputs, _ in read])

    def covariance(self, read: Read) -> np.ndarray:
        """Of what they are off by, (..., nx, nx)."""
        return _in_place(read, [decoder.covariance(inputs, age) for decoder, _, inputs, age in read])


def _in_place(read: Read, found: list[np.ndarray]) -> np.ndarray:
    """What decoders say, each in its rows."""
    if len(found) == 1:
        return found[0]
    rows = [np.asarray(rows) for _, rows, _, _ in read]
    out = np.empty((*rows[0].shape, *found[0].shape[1:]))
    for where, values in zip(rows, found):
        out[where] = values
    return out


class Decoder:
    """An inverse map at given levels of noise: z, (..., size), and the age in seconds to x_hat, (..., nx)."""

    def __init__(
        self,
        inverse: InverseMap,
        measurement_noise: float | tuple[float, ...],
        process_noise: float,
        *,
        compiled: bool = False,
    ) -> None:
        self._inverse, self.size = inverse, inverse.whiten.shape[1]
        self._whiten = np.ascontiguousarray((inverse.gain(measurement_noise)[:, None] * inverse.whiten).T)
        self._offset = -inverse.z_offset @ self._whiten
        self._conditions: list[Any] = [*inverse.noise_features(measurement_noise, process_noise)]
        self._told_age, self._singly = inverse.features[-1] == "age", compiled
        if inverse.spread is not None:
            shares = inverse.shares(measurement_noise, process_noise)
            self.covariance = Covariance(inverse.spread, shares, inverse.x_scale, compiled=compiled)

    def compiled(self, z: np.ndarray, age: Any) -> np.ndarray | None:
        """The estimate by machine code, of a large batch or, if so asked, one sample; None where NumPy is to do it."""
        if z.ndim == 1 and self._singly and self._compiled is not None:
            return self._compiled.single(z, age)
        if z.ndim == 2 and len(z) >= MANY_ROWS and self._compiled is not None:
            return self._compiled.batch(z, age)
        return None

    def read(self, z: np.ndarray, age: Any) -> np.ndarray:
        """What the network is given."""
        inverse, conditions = self._inverse, self._conditions
        modes = z @ self._whiten
        modes += self._offset
        if self._told_age:
            conditions = [*conditions, inverse.age_feature(age)]
        if modes.ndim == 1:  # a single sample: every call of numpy would be felt
            return np.array([*modes.tolist(), *conditions], dtype=np.float32)
        width = modes.shape[-1]
        inputs = np.empty((*modes.shape[:-1], width + len(conditions)), dtype=np.float32)
        inputs[..., :width] = modes
        for i, condition in enumerate(conditions):
            inputs[..., width + i] = condition
        return inputs

    def mean(self, inputs: np.ndarray) -> np.ndarray:
        """The estimate, (..., nx)."""
        inverse = self._inverse
        return inverse.x_offset + inverse.x_scale * inverse.mlp(inputs)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_compiled"}  # Numba is not everywhere

    @functools.cached_property
    def _compiled(self) -> CompiledDecoder | None:
        inverse, mlp = self._inverse, self._inverse.mlp
        if len(mlp.layers) < 2:
            return None
        try:
            return CompiledDecoder(
                mlp.layers,
                mlp.activation,
                whiten=self._whiten,
                offset=self._offset,
                conditions=self._conditions,
                age=(inverse.age_unit, inverse.age_max) if self._told_age else None,
                x_offset=inverse.x_offset,
                x_scale=inverse.x_scale,
            )
        except ImportError:
            return None
