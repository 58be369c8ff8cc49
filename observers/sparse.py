"""The filter's step without the zeros of its transition, as machine code where Numba is installed.

It is for large batches, and for single samples of long runs.

The modes of a filter do not mix, or only in pairs. A matrix product knows nothing of that, and reads and writes the
batch three times where once is enough: this takes a fifth to a half of its time.
"""

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from observers.machine import kernel


class SparseUpdate:
    """z_next = z transition^T + terms drive, for a transition with few entries off its diagonal."""

    def __init__(self, transition: np.ndarray, drive: np.ndarray) -> None:
        gains, _, mixing = parts = without_zeros(transition, drive)
        if len(mixing) > len(transition):
            raise ValueError(f"{len(mixing)} entries off the diagonal of {len(transition)} are too many to gain")
        self._terms, self._shape = len(drive), gains.shape
        self._batch, self._one = partial(_kernel(), *parts), partial(_single_kernel(), *parts)

    def __call__(self, z: np.ndarray, *terms: np.ndarray) -> np.ndarray:
        """Return the next z. Shapes: ``z`` (n, size), ``*terms`` (n, ...); returns (n, size)."""
        rows, size = self._shape
        if z.shape[1:] != (size,):
            raise ValueError(f"expected z of shape (n, {size}), got {z.shape}")
        columns = np.zeros((len(z), rows - 1))
        np.concatenate(terms, axis=1, out=columns[:, : self._terms])  # raises if they do not fit
        z = np.ascontiguousarray(z, dtype=float)
        z_next = np.empty(z.shape)
        self._batch(z, columns, z_next)
        return z_next

    def single(self, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray) -> np.ndarray:
        """Return the next z (size,) of one sample, from ``y`` (ny,), ``u`` (nu,) and ``y_next`` (ny,)."""
        z_next = np.empty(len(z))
        u = u.copy()  # the user's own: to Numba, an array that is read-only or has strides is of another type
        self._one(z, y, u, y_next, z_next)
        return z_next


def without_zeros(transition: np.ndarray, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the kernels take of a filter.

    Shapes: ``transition`` (size, size), ``drive`` (m, size); returns ``gains`` (1 + m or a few more, size), ``places``
    (2, k), ``mixing`` (k,).
    """
    diagonal, spare = transition.diagonal(), np.zeros((-len(drive) % 3, len(transition)))
    places = np.array(np.nonzero(transition - np.diag(diagonal)))
    return np.vstack([diagonal, drive, spare]), places, transition[*places]


@cache
def _single_kernel() -> Callable[..., None]:
    @kernel(fastmath=False)
    def update(
        gains: np.ndarray,
        places: np.ndarray,
        mixing: np.ndarray,
        z: np.ndarray,
        y: np.ndarray,
        u: np.ndarray,
        y_next: np.ndarray,
        z_next: np.ndarray,
    ) -> None:
        size, j = len(z), 1
        for i in range(size):
            z_next[i] = gains[0, i] * z[i]
        for values in (y, u, y_next):
            for value in values:
                for i in range(size):
                    z_next[i] += gains[j, i] * value
                j += 1
        for k in range(len(mixing)):
            z_next[places[0, k]] += mixing[k] * z[places[1, k]]

    return update


@cache
def _kernel() -> Callable[..., None]:
    @kernel()
    def update(
        gains: np.ndarray, places: np.ndarray, mixing: np.ndarray, z: np.ndarray, terms: np.ndarray, z_next: np.ndarray
    ) -> None:
        n, size = z.shape
        for row in range(n):
            a, b, c = terms[row, 0], terms[row, 1], terms[row, 2]  # y, u and the next y, if there is one of each
            for i in range(size):
                z_next[row, i] = gains[0, i] * z[row, i] + gains[1, i] * a + gains[2, i] * b + gains[3, i] * c
            for j in range(3, terms.shape[1], 3):
                a, b, c = terms[row, j], terms[row, j + 1], terms[row, j + 2]
                for i in range(size):
                    z_next[row, i] += gains[j + 1, i] * a + gains[j + 2, i] * b + gains[j + 3, i] * c
            for k in range(len(mixing)):
                z_next[row, places[0, k]] += mixing[k] * z[row, places[1, k]]

    return update
