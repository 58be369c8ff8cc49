"""The linear half of the observer, z' = A z + B y, integrated exactly between samples."""

import copy
import functools

import numpy as np

from observers.checks import check_dt, integer, real_array

MOST_INPUTS = 64  # that a filter takes; every one of them adds nz values to its state
MOST_VALUES = 1024  # of its state, and of the output; beyond them memory and the decomposition of A would be felt


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
    A : ndarray, shape (nz, nz)
        Hurwitz and diagonalisable, in 1/s. The state may have 1024 values.
    B : ndarray, shape (nz, ny)
        What the outputs act through, 1 to 1024 of them.
    dt : float
        Sampling interval in seconds.
    nu : int, default 0
        Number of known inputs that are filtered, 0 to 64; none make the paper's observer.

    Attributes
    ----------
    transition : ndarray, shape (size, size)
        What z_k+1 keeps of z_k.
    early_y, late_y : ndarray, shape (size, ny)
        What the outputs at the beginning and at the end of an interval add.
    held_u : ndarray, shape (size, nu)
        What the inputs held over an interval add.
    drive : ndarray, shape (2 ny + nu, size)
        early_y, held_u and late_y side by side, transposed.
    equilibrium : ndarray, shape (size, ny)
        The state that constant outputs lead to.
    """

    def __init__(self, A: np.ndarray, B: np.ndarray, dt: float, nu: int = 0) -> None:
        A, B = real_array("A", A).copy(), real_array("B", B).copy()  # the caller may reuse them
        if A.ndim != 2 or A.shape[0] != A.shape[1] or B.ndim != 2 or len(B) != len(A):
            raise ValueError(f"A must be (nz, nz) and B (nz, ny), got {A.shape} and {B.shape}")
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise ValueError("A and B must be finite")
        dt, nu = check_dt(dt), integer("nu, the number of inputs", nu, 0, MOST_INPUTS)
        nz, ny = B.shape
        if not (1 <= nz * (1 + nu) <= MOST_VALUES and 1 <= ny <= MOST_VALUES):
            raise ValueError(
                f"a filter has 1 to {MOST_VALUES} values, nz (1 + nu), and as many outputs at most; "
                f"got nz = {nz}, nu = {nu} and {ny} outputs"
            )
        poles, V = np.linalg.eig(A)
        if not (poles.real < 0).all():
            raise ValueError(f"A must be Hurwitz, but has eigenvalues {poles[poles.real >= 0]}")
        if not np.linalg.cond(V) <= 1e12:
            raise ValueError("A must be diagonalisable; separate its repeated eigenvalues")

        A.flags.writeable = B.flags.writeable = False  # what follows from them would not change
        self.A, self.B, self.nu = A, B, nu
        self._poles, self._V, self._V_inverse = poles, V, np.linalg.inv(V)
        with np.errstate(all="ignore"):
            self.equilibrium = self._on_z_y(-np.linalg.solve(A, B))
        self._integrate(dt)

    def _integrate(self, dt: float) -> None:
        """Take another sampling interval."""
        poles, blocks = self._poles, 1 + self.nu
        with np.errstate(all="ignore"):
            s = poles * dt
            hold = np.expm1(s) / poles  # integral of e^{poles (dt - t)} over [0, dt]
            late = (np.expm1(s) - s) / (poles * s)  # ... of e^{poles (dt - t)} t / dt
            transition, early, late, hold = (
                np.real((self._V * values) @ self._V_inverse) for values in (np.exp(s), hold - late, late, hold)
            )
            self.dt, self.transition = dt, np.kron(np.eye(blocks), transition)
            self.early_y, self.late_y = self._on_z_y(early @ self.B), self._on_z_y(late @ self.B)
            self.held_u = np.kron(np.eye(blocks, self.nu, -1), hold @ self.B.sum(1, keepdims=True))
        self.drive = np.hstack([self.early_y, self.held_u, self.late_y]).T.copy()
        self._update = np.vstack([self.transition.T, self.drive])
        if not (np.isfinite(self._update).all() and np.isfinite(self.equilibrium).all()):
            raise ValueError(
                f"dt = {dt!r}, B of up to {abs(self.B).max():g} and the eigenvalues of A, {poles}, lead beyond the "
                "range of floats"
            )

    def _on_z_y(self, matrix: np.ndarray) -> np.ndarray:
        return np.vstack([matrix, np.zeros((self.nu * len(self.A), matrix.shape[1]))])

    @functools.lru_cache(maxsize=64)  # noqa: B019 - intervals of samples that are irregular often come again
    def at(self, dt: float) -> "LinearFilter":
        """Return the same filter at another sampling interval."""
        other = copy.copy(self)
        other._integrate(dt)
        return other

    @property
    def size(self) -> int:
        """Number of components of the filter's state, nz * (1 + nu)."""
        return len(self.transition)

    @property
    def slowest(self) -> float:
        """Rate in 1/s at which the slowest mode forgets: the least size of a real part of A's eigenvalues."""
        return float(np.abs(np.linalg.eigvals(self.A).real).min())

    def start(self, y0: np.ndarray) -> np.ndarray:
        """Return the state that a constant output leads to: z_y = -A^-1 B y0, z_u = 0.

        Shapes: ``y0`` (..., ny); returns (..., size).
        """
        return y0 @ self.equilibrium.T

    def advance(self, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray) -> np.ndarray:
        """Return the state one sample later.

        Shapes: ``z`` (..., size), ``y`` (..., ny) at the same time, ``u`` (..., nu) held until the next sample,
        ``y_next`` (..., ny) there; returns (..., size). Raises ValueError if they do not go together.
        """
        return np.concatenate((z, y, u, y_next), axis=-1) @ self._update
