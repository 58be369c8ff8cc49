"""How far an estimate may be off: the covariance of its error, as it was learned."""

import copy
import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Any

import numpy as np

from observers.compiled_covariance import CompiledCovariance
from observers.factors import Factors
from observers.network import MLP

LARGEST_LOG = 100.0  # of a standard deviation: whatever a network says far from its training, its square stays finite
LARGEST = 4.0  # of a standard deviation, in multiples of its state's: an estimate is hardly worse than none


@dataclass(frozen=True)
class Spread:
    """The covariance of x - x_hat, as far as what T_inv is told says it.

    It is factor * D L L^T D, with standard deviations cut to ``LARGEST`` times their state's. The network has the
    inputs of T_inv's own. Its first nx outputs are the logarithms of D, which is diagonal, the others the entries of L
    below its diagonal of ones, row by row. All are in scaled units, those of :attr:`observers.InverseMap.x_scale`. The
    factors are those of :class:`observers.factors.Factors`.

    Parameters
    ----------
    mlp : MLP
        The network, of nx (nx + 1) / 2 outputs.
    levels : ndarray, shape (k,)
    ages : ndarray, shape (m,)
    factors : ndarray, shape (k, m) or (2, k, m)
        As there.

    Raises
    ------
    ValueError
        If the network makes no covariance, or as there.
    """

    mlp: MLP
    levels: np.ndarray
    ages: np.ndarray
    factors: np.ndarray

    def __post_init__(self) -> None:
        Factors(self.levels, self.ages, self.factors)  # or what is wrong with them
        if not self.nx or self.nx * (self.nx + 1) // 2 != self.mlp.outputs:
            raise ValueError(f"a network of {self.mlp.outputs} outputs makes no covariance: it takes 1, 3, 6, 10, …")

    @property
    def nx(self) -> int:
        """Number of states."""
        return (math.isqrt(8 * self.mlp.outputs + 1) - 1) // 2

    def largest_variances(self, scale: np.ndarray) -> np.ndarray:
        """What variances are cut to, (nx,), in units of states of a scale."""
        return np.maximum(np.square(LARGEST * np.abs(scale[: self.nx])), np.finfo(float).tiny)

    def in_units(self, scale: np.ndarray) -> MLP:
        """The network with the scale of the states in its last biases: the logarithms are of D in their units.

        Behind the states there may be parameters, of whose errors nothing is said.
        """
        *biases, bias = (np.array(each, dtype=float) for each in self.mlp.biases)
        bias[: self.nx] += np.log(np.maximum(np.abs(scale[: self.nx]), np.finfo(float).tiny))
        return MLP(self.mlp.weights, [*biases, bias], self.mlp.activation)


class Covariance:
    """A spread at given levels of noise: what T_inv's network is given, and the age, to covariances."""

    def __init__(self, spread: Spread, levels: tuple[float, float], scale: np.ndarray) -> None:
        self._nx, self._mlp = spread.nx, spread.in_units(scale)
        self._largest = spread.largest_variances(scale)
        self._ages = spread.ages.tolist()
        self._log_factors = Factors(spread.levels, spread.ages, spread.factors).log_roots(*levels).tolist()

    def __call__(self, inputs: np.ndarray, age: Any) -> np.ndarray:
        """Evaluate. Shapes: ``inputs`` (..., inputs); returns (..., nx, nx)."""
        nx, out = self._nx, self._mlp(inputs)
        if out.ndim == 1:  # a single sample: every call would be felt
            entries = _entries(out.tolist(), nx, self._log_factor(float(age)))
            return np.array(_cut(entries, self._largest.tolist())).reshape(nx, nx)
        values = np.moveaxis(out, -1, 0).astype(float, order="C")
        np.minimum(values[:nx], LARGEST_LOG, out=values[:nx])
        values[:nx] += np.interp(age, self._ages, self._log_factors)
        np.exp(values[:nx], out=values[:nx])
        covariance = np.empty((*out.shape[:-1], nx * nx))
        for i, entry in enumerate(_product(values[:nx], values[nx:])):
            covariance[..., i] = entry
        variances = covariance[..., :: nx + 1]
        too_large = variances > self._largest
        shares = np.sqrt(self._largest / np.where(too_large, variances, self._largest)) if too_large.any() else None
        covariance = covariance.reshape(*out.shape[:-1], nx, nx)
        return covariance if shares is None else covariance * (shares[..., None] * shares[..., None, :])

    def compiled(self, **inputs: Any) -> CompiledCovariance | None:
        """The same for single samples as machine code; None without Numba, or for a network of other than two layers.

        The arguments are those of :class:`observers.compiled_covariance.CompiledCovariance` that say what the network
        is given.
        """
        layers = self._mlp.layers
        if len(layers) != 2:
            return None
        try:
            return CompiledCovariance(
                layers,
                self._mlp.activation,
                nx=self._nx,
                ages=self._ages,
                log_factors=self._log_factors,
                largest_log=LARGEST_LOG,
                largest=self._largest,
                **inputs,
            )
        except ImportError:
            return None

    def behind(self) -> "Covariance":
        """The same from what comes out of the first layer."""
        other = copy.copy(self)
        other._mlp = self._mlp.behind()
        return other

    def _log_factor(self, age: float) -> float:
        """As np.interp, without its overhead."""
        ages, values = self._ages, self._log_factors
        i = bisect_right(ages, age)
        if i == len(ages):
            return values[-1]
        share = (age - ages[i - 1]) / (ages[i] - ages[i - 1])
        return values[i - 1] + share * (values[i] - values[i - 1])


def _entries(values: list[float], nx: int, factor: float) -> list[float]:
    """The covariance of one sample, row by row; written out for two or three states: loops take thrice as long."""
    exp, end = math.exp, LARGEST_LOG
    if nx == 2:
        a, b, d = values
        a, b = exp((end if a > end else a) + factor), exp((end if b > end else b) + factor)
        d = b * d
        side = a * d
        return [a * a, side, side, d * d + b * b]
    if nx == 3:
        a, b, c, d, e, f = values
        a, b = exp((end if a > end else a) + factor), exp((end if b > end else b) + factor)
        c = exp((end if c > end else c) + factor)
        d, e, f = b * d, c * e, c * f
        side, corner, last = a * d, a * e, d * e + b * f
        return [a * a, side, corner, side, d * d + b * b, last, corner, last, e * e + f * f + c * c]
    return _product([exp(min(value, end) + factor) for value in values[:nx]], values[nx:])


def _cut(entries: list[float], largest: list[float]) -> list[float]:
    """A covariance, row by row, with variances that are no larger than these, and the same correlations."""
    nx = len(largest)
    variances = entries[:: nx + 1]
    if not any(variance > end for variance, end in zip(variances, largest, strict=True)):
        return entries
    shares = [math.sqrt(end / max(variance, end)) for variance, end in zip(variances, largest, strict=True)]
    return [entry * (shares[i // nx] * shares[i % nx]) for i, entry in enumerate(entries)]


def _product(scales: Any, lower: Any) -> list[Any]:
    """D L L^T D row by row, from D and what L has below its diagonal: of numbers, or of arrays that hold a batch."""
    nx, k = len(scales), 0
    rows: list[list[Any]] = []
    covariance: list[Any] = [0.0] * (nx * nx)
    for i, scale in enumerate(scales):
        row = []
        for _ in range(i):
            row.append(scale * lower[k])  # a comprehension takes longer for so few
            k += 1
        row.append(scale)
        rows.append(row)
        for j, other in enumerate(rows):
            entry = row[0] * other[0]
            for m in range(1, j + 1):
                entry = entry + row[m] * other[m]
            covariance[nx * i + j] = covariance[nx * j + i] = entry
    return covariance


def deviations(covariance: np.ndarray) -> np.ndarray:
    """Standard deviations (..., nx) of what has covariances (..., nx, nx)."""
    return np.sqrt(covariance.diagonal(0, -2, -1))


__all__ = ["LARGEST", "LARGEST_LOG", "Covariance", "Spread", "deviations"]
