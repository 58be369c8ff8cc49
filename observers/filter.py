"""The linear half of the observer, z' = A z + B y, integrated exactly between samples."""

import functools
from typing import Any

import numpy as np

from observers.sparse import MANY_ROWS, SparseUpdate


class LinearFilter:
    """z_y' = A z_y + B y and, for each known input, z_u' = A z_u + B 1 u, at the sampling interval ``dt``.

    The output is taken as linear between samples (first-order hold, causal because y_k+1 is at hand when z_k+1 is
    wanted; a zero-order hold would act as half a sample of delay) and the input as constant (it is). Filtering the
    input beside the output is the functional KKL observer (Buisson-Fenet et al., TMLR 2023); with u = 0 what remains
    is the paper's (sec. 3, eq. kkl_observer).

    The filter's state is ``z = [z_y, z_u of the first input, ...]``, of size ``nz * (1 + nu)``, and
    z_k+1 = transition z_k + early_y y_k + late_y y_k+1 + held_u u_k.

    Parameters
    ----------
    A : (nz, nz), Hurwitz and diagonalisable, in 1/s.
    B : (nz, ny).
    dt : sampling interval in seconds.
    nu : number of known inputs that are filtered, 0 for the paper's observer.

    Raises
    ------
    ValueError : if a shape is wrong, A is not Hurwitz or not diagonalisable, or dt <= 0.
    """

    def __init__(self, A: np.ndarray, B: np.ndarray, dt: float, nu: int = 0) -> None:
        A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
        if A.ndim != 2 or A.shape[0] != A.shape[1] or B.ndim != 2 or len(B) != len(A):
            raise ValueError(f"A must be (nz, nz) and B (nz, ny), got {A.shape} and {B.shape}")
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise ValueError("A and B must be finite")
        if not 0 < dt < np.inf:
            raise ValueError(f"dt must be a positive, finite number of seconds, got {dt!r}")
        if np.count_nonzero(A - np.diag(A.diagonal())):
            poles, V = np.linalg.eig(A)
        else:
            poles, V = A.diagonal(), np.eye(len(A))
        if not (poles.real < 0).all():
            raise ValueError(f"A must be Hurwitz, but has eigenvalues {poles[poles.real >= 0]}")
        if np.linalg.cond(V) > 1e12:
            raise ValueError("A must be diagonalisable; separate its repeated eigenvalues")

        def function_of_A(values: np.ndarray) -> np.ndarray:
            return np.real((V * values) @ np.linalg.inv(V))

        s = poles * dt
        hold = np.expm1(s) / poles  # integral of e^{poles (dt - t)} over [0, dt]
        late = (np.expm1(s) - s) / (poles * s)  # ... of e^{poles (dt - t)} t / dt
        nz, ny = B.shape
        blocks = 1 + nu

        def acts_on_z_y(matrix: np.ndarray) -> np.ndarray:
            return np.vstack([matrix, np.zeros((nu * nz, ny))])

        self.A, self.B, self.dt, self.nu = A, B, float(dt), nu
        self.transition = np.kron(np.eye(blocks), function_of_A(np.exp(s)))
        self.early_y = acts_on_z_y(function_of_A(hold - late) @ B)
        self.late_y = acts_on_z_y(function_of_A(late) @ B)
        self.held_u = np.kron(np.eye(blocks, nu, -1), function_of_A(hold) @ B.sum(1, keepdims=True))
        self.equilibrium = acts_on_z_y(-np.linalg.solve(A, B))
        self._drive = np.hstack([self.early_y, self.held_u, self.late_y]).T.copy()
        self._update = np.vstack([self.transition.T, self._drive])

    @property
    def size(self) -> int:
        """Number of components of the filter's state, nz * (1 + nu)."""
        return len(self.transition)

    def start(self, y0: np.ndarray) -> np.ndarray:
        """The state that a constant output y0, (..., ny), would have led to: z_y = -A^-1 B y0, z_u = 0."""
        return y0 @ self.equilibrium.T

    def advance(self, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray) -> np.ndarray:
        """The state one sample later.

        z : (..., size); y, y_next : (..., ny), the outputs at both ends; u : (..., nu), held between them. A batch
        (n, size) of many rows goes through Numba where it is installed, which rounds a little differently.
        """
        if z.ndim == 2 and len(z) >= MANY_ROWS and self._compiled is not None:
            return self._compiled(z, y, u, y_next)
        return np.concatenate((z, y, u, y_next), axis=-1) @ self._update

    def run(self, y: np.ndarray, u: np.ndarray, ages: np.ndarray) -> np.ndarray:
        """States at ``ages``, (m, n, size), along outputs (steps + 1, n, ny) and inputs (steps, n, nu)."""
        z = self.start(y[0])
        out = np.empty((len(ages), *z.shape))
        slot = {int(age): i for i, age in enumerate(ages)}
        for k in range(len(y)):
            if k > 0:
                z = self.advance(z, y[k - 1], u[k - 1], y[k])
            if k in slot:
                out[slot[k]] = z
        return out

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_compiled"}  # Numba is not everywhere

    @functools.cached_property
    def _compiled(self) -> SparseUpdate | None:
        try:
            return SparseUpdate(self.transition, self._drive)
        except (ImportError, ValueError):
            return None
