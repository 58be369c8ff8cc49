"""Error bars as machine code, where Numba is installed: all of it for a single sample, the first layer for a batch."""

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from observers.compiled import Layers, active_kernel, batch_kernels, entering_kernel, first_layer
from observers.machine import fast_kernel, fast_part


class CompiledCovariance:
    """From the filter's state to the covariance of the estimate's error, by one call for a single sample."""

    def __init__(
        self,
        layers: Layers,
        activation: str,
        *,
        whiten: np.ndarray,
        offset: np.ndarray,
        conditions: Sequence[float],
        age: tuple[float, float] | None,
        nx: int,
        ages: Sequence[float],
        log_factors: Sequence[float],
        largest_log: float,
        largest: np.ndarray,
    ) -> None:
        first = first_layer(layers[0], whiten=whiten, offset=offset, conditions=conditions, age=age)
        second = np.ascontiguousarray(np.vstack(layers[1]).T, dtype=float)  # a row for each output, the bias last
        table = np.array([ages, log_factors], dtype=float)
        self._shape = (nx, nx)
        self._first, self._activation, self._age = first, activation, age or (1.0, 0.0)
        unit, end = (float(each) for each in self._age)
        self._one = functools.partial(_covary(activation), first, second, table, unit, end, largest_log, largest)

    def single(self, z: np.ndarray, age: float) -> np.ndarray:
        """Evaluate for one sample. Shapes: ``z`` (size,); returns (nx, nx)."""
        covariance = np.empty(self._shape)
        self._one(z, age, covariance)
        return covariance

    def hidden(self, z: np.ndarray, age: float | np.ndarray) -> np.ndarray:
        """Evaluate the first layer for many samples. Shapes: ``z`` (n, size), ``age`` (n,); returns (n, width)."""
        sums, (unit, end) = z @ self._first[2:], self._age
        h = np.empty(sums.shape, np.float32)
        batch_kernels(self._activation).enter(
            sums, self._first, np.full(len(z), np.log1p(np.minimum(age, end) / unit)), h
        )
        return h


@functools.cache
def _covary(activation: str) -> Callable[..., None]:
    """The whole of it, for one sample."""
    active, enter = active_kernel(activation), entering_kernel()

    @fast_part
    def output(row: np.ndarray, h: np.ndarray) -> float:
        total = row[len(h)]
        for j in range(len(h)):
            total += row[j] * h[j]
        return total

    @fast_part
    def interpolated(age: float, table: np.ndarray) -> float:  # as np.interp, which takes a second to compile
        last = table.shape[1] - 1
        if age >= table[0, last]:
            return table[1, last]
        i = 0
        while age >= table[0, i + 1]:
            i += 1
        share = (age - table[0, i]) / (table[0, i + 1] - table[0, i])
        return table[1, i] + share * (table[1, i + 1] - table[1, i])

    @fast_kernel
    def covary(
        first: np.ndarray,
        second: np.ndarray,
        table: np.ndarray,
        age_unit: float,
        age_max: float,
        largest_log: float,
        largest: np.ndarray,
        z: np.ndarray,
        age: float,
        out: np.ndarray,
    ) -> None:
        width, nx = first.shape[1], len(out)
        h = np.empty(width)
        enter(first, math.log1p(min(age, age_max) / age_unit), z, h)
        for j in range(width):
            h[j] = active(np.float32(h[j]))
        factor = interpolated(age, table)
        entry = nx
        for i in range(nx):  # D L
            scale = math.exp(min(output(second[i], h), largest_log) + factor)
            out[i, i], variance = scale, scale * scale
            for j in range(i):
                out[i, j] = scale * output(second[entry], h)
                variance += out[i, j] * out[i, j]
                entry += 1
            if variance > largest[i]:
                share = math.sqrt(largest[i] / variance)
                for j in range(i + 1):
                    out[i, j] *= share
        for i in range(nx - 1, -1, -1):  # its square takes its place: from the end on, nothing is needed that is gone
            for j in range(i, -1, -1):
                total = 0.0
                for k in range(j + 1):
                    total += out[i, k] * out[j, k]
                out[i, j] = total
                out[j, i] = total

    return covary
