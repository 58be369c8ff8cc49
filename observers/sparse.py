"""The filter's step without the zeros of its transition, as machine code where Numba is installed.

It is for large batches, and for single samples of long runs.

The modes of a filter do not mix, or only in pairs. A matrix product knows nothing of that, and reads and writes the
batch three times where once is enough: this takes a fifth to a half of its time.
"""

import functools
from collections.abc import Callable

import numpy as np

MANY_ROWS = 128  # fewer gain too little to wait a second for the compiler


class SparseUpdate:
    """z_next = z transition^T + terms drive, for a transition with few entries off its diagonal.

    Parameters
    ----------
    transition : ndarray, shape (size, size)
        At most ``size`` entries off its diagonal may differ from zero.
    drive : ndarray, shape (m, size)
        What each column of the terms adds.

    Raises
    ------
    ImportError
        If Numba is not installed.
    ValueError
        If the transition has too many entries for this to gain anything.
    """

    def __init__(self, transition: np.ndarray, drive: np.ndarray) -> None:
        self._diagonal = transition.diagonal().copy()
        self._rows, self._columns = np.nonzero(transition - np.diag(self._diagonal))
        if len(self._rows) > len(transition):
            raise ValueError(f"{len(self._rows)} entries off the diagonal of {len(transition)} are too many to gain")
        self._mixing = transition[self._rows, self._columns]
        self._terms = len(drive)
        self._drive = np.pad(drive, ((0, -len(drive) % 3), (0, 0)))  # the kernel takes three terms at once
        _kernel()  # or say now that there is no Numba

    def __call__(self, z: np.ndarray, *terms: np.ndarray) -> np.ndarray:
        """Return the next z.

        Parameters
        ----------
        z : ndarray, shape (n, size)
            The filter's state.
        *terms : ndarray, shape (n, ...)
            What drives it, m columns together.

        Returns
        -------
        ndarray, shape (n, size)
            The state one sample later.

        Raises
        ------
        ValueError
            If a shape is wrong.
        """
        if z.shape[1:] != self._diagonal.shape:
            raise ValueError(f"expected z of shape (n, {len(self._diagonal)}), got {z.shape}")
        columns = np.zeros((len(z), len(self._drive)))
        np.concatenate(terms, axis=1, out=columns[:, : self._terms])  # raises if they do not fit
        z = np.ascontiguousarray(z, dtype=float)
        z_next = np.empty(z.shape)
        _kernel()(z, columns, self._diagonal, self._drive, self._rows, self._columns, self._mixing, z_next)
        return z_next

    def single(self, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray) -> np.ndarray:
        """Return the next z of one sample.

        Parameters
        ----------
        z : ndarray, shape (size,)
            The filter's state.
        y, u, y_next : ndarray, shape (ny,), (nu,), (ny,)
            What drives it, m values together.

        Returns
        -------
        ndarray, shape (size,)
            The state one sample later.
        """
        z_next = np.empty(len(z))
        u = u.copy()  # the user's own: to Numba, an array that is read-only or has strides is of another type
        _single()(z, y, u, y_next, self._diagonal, self._drive, self._rows, self._columns, self._mixing, z_next)
        return z_next


@functools.cache
def _single() -> Callable[..., None]:
    import numba

    @numba.njit
    def update(
        z: np.ndarray,
        y: np.ndarray,
        u: np.ndarray,
        y_next: np.ndarray,
        diagonal: np.ndarray,
        drive: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
        mixing: np.ndarray,
        z_next: np.ndarray,
    ) -> None:
        size, j = len(z), 0
        for i in range(size):
            z_next[i] = diagonal[i] * z[i]
        for part in (y, u, y_next):
            for value in part:
                for i in range(size):
                    z_next[i] += drive[j, i] * value
                j += 1
        for k in range(len(rows)):
            z_next[rows[k]] += mixing[k] * z[columns[k]]

    return update


@functools.cache
def _kernel() -> Callable[..., None]:
    import numba

    @numba.njit
    def update(
        z: np.ndarray,
        terms: np.ndarray,
        diagonal: np.ndarray,
        drive: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
        mixing: np.ndarray,
        z_next: np.ndarray,
    ) -> None:
        n, size = z.shape
        for row in range(n):
            a, b, c = terms[row, 0], terms[row, 1], terms[row, 2]  # y, u and the next y, if there is one of each
            for i in range(size):
                z_next[row, i] = diagonal[i] * z[row, i] + drive[0, i] * a + drive[1, i] * b + drive[2, i] * c
            for j in range(3, len(drive), 3):
                a, b, c = terms[row, j], terms[row, j + 1], terms[row, j + 2]
                for i in range(size):
                    z_next[row, i] += drive[j, i] * a + drive[j + 1, i] * b + drive[j + 2, i] * c
            for k in range(len(rows)):
                z_next[row, rows[k]] += mixing[k] * z[row, columns[k]]

    return update
