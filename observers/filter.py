"""The linear half of the observer, z' = A z + B y, integrated exactly between samples."""

import copy
import functools

import numpy as np

from observers.checks import check_dt, integer, real_array

MOST_INPUTS = 64  # largest nu; each input adds nz values to the filter's state
MOST_VALUES = 1024  # largest nz (1 + nu), and largest ny; more would need much memory and time


class LinearFilter:
    """z_y' = A z_y + B y and, for each known input, z_u' = A z_u + B 1 u, at the sampling interval ``dt``.

    Here 1 is a vector of ones. The integration takes the output as linear between samples, a first-order hold. This is
    causal, because z_k+1 is computed when y_k+1 is known; a zero-order hold would delay the output by half a sample.
    The input is constant between samples. With inputs, this is the filter of the functional KKL observer (Buisson-Fenet
    et al., TMLR 2023); without, the filter of Niazi et al. (2025, eq. 7). Raises ValueError if A, B, dt or nu is
    invalid.

    The filter's state is ``z = [z_y, z_u of the first input, ...]``, of size ``nz * (1 + nu)``, and
    z_k+1 = transition z_k + early_y y_k + late_y y_k+1 + held_u u_k.

    Parameters
    ----------
    A : ndarray, shape (nz, nz)
        State matrix in 1/s, Hurwitz and diagonalisable. The filter's state may have at most 1024 values.
    B : ndarray, shape (nz, ny)
        Matrix from y to z_y'; there may be 1 to 1024 outputs.
    dt : float
        Sampling interval in seconds.
    nu : int, default 0
        Number of known inputs to filter, 0 to 64. The observer of Niazi et al. has none.

    Attributes
    ----------
    transition : ndarray, shape (size, size)
        Matrix from z_k to z_k+1.
    early_y, late_y : ndarray, shape (size, ny)
        Matrices to z_k+1 from the outputs at the beginning and at the end of the interval.
    held_u : ndarray, shape (size, nu)
        Matrix to z_k+1 from the inputs held over the interval.
    drive : ndarray, shape (2 ny + nu, size)
        early_y, held_u and late_y side by side, transposed.
    equilibrium : ndarray, shape (size, ny)
        Matrix from constant outputs to the steady state of z.
    """

    def __init__(self, A: np.ndarray, B: np.ndarray, dt: float, nu: int = 0) -> None:
        A, B = real_array("A", A).copy(), real_array("B", B).copy()  # the caller may reuse its arrays
        if A.ndim != 2 or A.shape[0] != A.shape[1] or B.ndim != 2 or len(B) != len(A):
            raise ValueError(f"A must be (nz, nz) and B (nz, ny), got {A.shape} and {B.shape}")
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise ValueError("A and B must be finite")
        dt, nu = check_dt(dt), integer("nu, the number of inputs", nu, 0, MOST_INPUTS)
        nz, ny = B.shape
        if not (1 <= nz * (1 + nu) <= MOST_VALUES and 1 <= ny <= MOST_VALUES):
            raise ValueError(
                f"the filter's size nz (1 + nu) and ny must be from 1 to {MOST_VALUES}, "
                f"got nz = {nz}, nu = {nu} and ny = {ny}"
            )
        poles, V = np.linalg.eig(A)
        if not (poles.real < 0).all():
            raise ValueError(f"A must be Hurwitz, but has eigenvalues {poles[poles.real >= 0]}")
        if not np.linalg.cond(V) <= 1e12:
            raise ValueError("A must be diagonalisable; separate its repeated eigenvalues")

        A.flags.writeable = B.flags.writeable = False  # a later change would not reach the matrices below
        self.A, self.B, self.nu = A, B, nu
        self._poles, self._V, self._V_inverse = poles, V, np.linalg.inv(V)
        with np.errstate(all="ignore"):
            self.equilibrium = self._on_z_y(-np.linalg.solve(A, B))
        self._integrate(dt)

    def _integrate(self, dt: float) -> None:
        """Compute the matrices for a sampling interval."""
        poles, blocks = self._poles, 1 + self.nu
        with np.errstate(all="ignore"):
            s = poles * dt
            hold = np.expm1(s) / poles  # integral of e^{poles (dt - t)} over [0, dt]
            late = (np.expm1(s) - s) / (poles * s)  # integral of e^{poles (dt - t)} t / dt over [0, dt]
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
                f"the filter's matrices are beyond the range of floats for dt = {dt!r}, entries of B up to "
                f"{abs(self.B).max():g} and eigenvalues {poles} of A"
            )

    def _on_z_y(self, matrix: np.ndarray) -> np.ndarray:
        return np.vstack([matrix, np.zeros((self.nu * len(self.A), matrix.shape[1]))])

    @functools.lru_cache(maxsize=64)  # noqa: B019 - irregular intervals often recur
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
        """Decay rate of the slowest mode in 1/s: the smallest absolute real part of A's eigenvalues."""
        return float(np.abs(np.linalg.eigvals(self.A).real).min())

    def start(self, y0: np.ndarray) -> np.ndarray:
        """Return the steady state under a constant output: z_y = -A^-1 B y0, z_u = 0.

        Shapes: ``y0`` (..., ny); returns (..., size).
        """
        return y0 @ self.equilibrium.T

    def advance(self, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray) -> np.ndarray:
        """Return the state one sample later.

        Shapes: ``z`` (..., size), ``y`` (..., ny) at the time of z, ``u`` (..., nu) held until the next sample,
        ``y_next`` (..., ny) at the next sample; returns (..., size). Raises ValueError if the shapes do not match.
        """
        return np.concatenate((z, y, u, y_next), axis=-1) @ self._update
