"""From the filter's state to the estimate, and to the covariance of what that is off by, at given levels of noise."""

import functools
from typing import Any, Self

import numpy as np

from observers.artifact import Artifact
from observers.compiled import CompiledDecoder
from observers.compiled_covariance import CompiledCovariance
from observers.inverse import InverseMap
from observers.network import ACTIVATIONS
from observers.spread import Covariance
from observers.thresholds import MANY_ROWS

# Which decoder is asked, in which rows (None for all), the filter's state and its age in seconds there, and where that
# was computed what the networks are given, and the covariance.
Parts = list[tuple["Decoder", np.ndarray | None, np.ndarray, Any, np.ndarray | None, np.ndarray | None]]


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
        return self.covariance(self.parts(z, age))

    def estimate(self, z: np.ndarray, age: Any, both: bool = False) -> tuple[Parts, np.ndarray]:
        """The estimates, (..., nx), and what :meth:`covariance` takes; ``both`` if that is likely to be called."""
        parts = self.parts(z, age)
        if len(parts) == 1:  # most often
            decoder, _, z, age, _, _ = parts[0]
            x_hat = decoder.compiled(z, age)
            if x_hat is not None:
                return parts, x_hat
            if both and z.ndim == 1 and decoder.both is not None:
                x_hat, covariance = decoder.both(decoder.read(z, age), age)
                return [(decoder, None, z, age, None, covariance)], x_hat
        else:
            found = [decoder.compiled(z, age) for decoder, _, z, age, _, _ in parts]
            whole = [x_hat for x_hat in found if x_hat is not None]
            if len(whole) == len(parts):
                return parts, _in_place(parts, whole)
        inputs = [decoder.read(z, age) for decoder, _, z, age, _, _ in parts]
        means = [decoder.mean(each) for (decoder, *_), each in zip(parts, inputs)]
        return [(*part[:4], each, None) for part, each in zip(parts, inputs)], _in_place(parts, means)

    def covariance(self, parts: Parts) -> np.ndarray:
        """Of what the estimates are off by, (..., nx, nx)."""
        if len(parts) == 1:  # most often
            decoder, _, z, age, inputs, known = parts[0]
            return decoder.covariance(z, age, inputs) if known is None else known.copy()
        return _in_place(parts, [decoder.covariance(z, age, inputs) for decoder, _, z, age, inputs, _ in parts])

    def parts(self, z: np.ndarray, age: Any) -> Parts:
        """Which decoder is asked in which rows, for filter states, (..., size), of these ages in seconds."""
        driven, free = self._driven, self._free
        if free is None:
            return [(driven, None, z, age, None, None)]
        nz = free.size  # behind it lies z_u, exactly 0 until an input acts
        if z.ndim == 1:  # a single sample: every call of numpy would be felt
            if z[-1] or any(z[nz:].tolist()):
                return [(driven, None, z, age, None, None)]
            return [(free, None, z[:nz], age, None, None)]
        moved = z[..., -1] != 0  # most often
        moved = moved if moved.all() else np.asarray(z[..., nz:].any(-1))
        if moved.all():
            return [(driven, None, z, age, None, None)]
        if not moved.any():
            return [(free, None, z[..., :nz], age, None, None)]
        age, still = np.broadcast_to(age, moved.shape), ~moved
        return [
            (driven, moved, z[moved], age[moved], None, None),
            (free, still, z[still][:, :nz], age[still], None, None),
        ]


def _in_place(parts: Parts, found: list[np.ndarray]) -> np.ndarray:
    """What decoders say, each in its rows."""
    if len(found) == 1:
        return found[0]
    rows = [np.asarray(rows) for _, rows, *_ in parts]
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
            self._covariance = Covariance(inverse.spread, shares, inverse.x_scale)

    def compiled(self, z: np.ndarray, age: Any) -> np.ndarray | None:
        """The estimate by machine code, of a large batch or, if so asked, one sample; None where NumPy is to do it."""
        if z.ndim == 1 and self._singly and self._compiled is not None:
            return self._compiled.single(z, age)
        if z.ndim == 2 and len(z) >= MANY_ROWS and self._compiled is not None:
            return self._compiled.batch(z, age)
        return None

    def covariance(self, z: np.ndarray, age: Any, inputs: np.ndarray | None) -> np.ndarray:
        """Of what the estimate is off by, (..., nx, nx); what :meth:`read` says may be known already."""
        if z.ndim == 1 and self._singly and self._compiled_covariance is not None:
            return self._compiled_covariance.single(z, age)
        if z.ndim == 2 and len(z) >= MANY_ROWS and self._compiled_covariance is not None:
            return self._behind(self._compiled_covariance.hidden(z, age), age)
        return self._covariance(self.read(z, age) if inputs is None else inputs, age)

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
        made = "_compiled", "_compiled_covariance", "_behind", "both"  # anew where it goes: Numba is not everywhere
        return {name: value for name, value in self.__dict__.items() if name not in made}

    @functools.cached_property
    def _behind(self) -> Covariance:
        """From what its first layer says."""
        return self._covariance.behind()

    @functools.cached_property
    def both(self) -> "Both | None":
        """The estimate of one sample and its covariance by NumPy; None where their networks share nothing."""
        mlp, spread = self._inverse.mlp, self._inverse.spread
        if (
            spread is None
            or spread.mlp.activation != mlp.activation
            or min(len(mlp.layers), len(spread.mlp.layers)) < 2
        ):
            return None
        return Both(self._inverse, spread.mlp.layers[0], self._behind)

    @functools.cached_property
    def _compiled(self) -> CompiledDecoder | None:
        inverse, mlp = self._inverse, self._inverse.mlp
        if len(mlp.layers) < 2:
            return None
        try:
            return CompiledDecoder(
                mlp.layers, mlp.activation, x_offset=inverse.x_offset, x_scale=inverse.x_scale, **self._inputs
            )
        except ImportError:
            return None

    @functools.cached_property
    def _compiled_covariance(self) -> CompiledCovariance | None:
        return self._covariance.compiled(**self._inputs)

    @property
    def _inputs(self) -> dict[str, Any]:
        """How the networks' inputs come from z and the age, as compiled maps take it."""
        age = (self._inverse.age_unit, self._inverse.age_max) if self._told_age else None
        return {"whiten": self._whiten, "offset": self._offset, "conditions": self._conditions, "age": age}


class Both:
    """An estimate and the covariance of what it is off by, of one sample: their first layers are one matrix product."""

    def __init__(self, inverse: InverseMap, layer: tuple[np.ndarray, np.ndarray], covariance: Covariance) -> None:
        mlp = inverse.mlp
        self._weight, self._bias = (np.hstack(parts) for parts in zip(mlp.layers[0], layer, strict=True))
        self._width, self._active = len(mlp.layers[0][1]), ACTIVATIONS[mlp.activation]
        self._x_offset, self._x_scale = inverse.x_offset, inverse.x_scale
        self._mean, self._covariance = mlp.behind(), covariance

    def __call__(self, inputs: np.ndarray, age: float) -> tuple[np.ndarray, np.ndarray]:
        """From what the networks are given, and the age in seconds."""
        h = inputs.dot(self._weight)
        h += self._bias
        h = self._active(h)
        width = self._width
        x_hat = self._x_offset + self._x_scale * self._mean(h[:width])
        return x_hat, self._covariance(h[width:], age)
