"""The linear half of the observer, z' = A z + B y, integrated exactly between samples."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LinearFilter:
    """z_y' = A z_y + B y and, for each known input, z_u' = A z_u + B 1 u, at the sampling interval ``dt``.

    The output is taken as linear between samples (first-order hold, causal because y_k+1 is at hand when z_k+1 is
    wanted; a zero-order hold would act as half a sample of delay) and the input as constant (it is). Filtering the
    input beside the output is the functional KKL observer (Buisson-Fenet et al., TMLR 2023); with u = 0 what remains
    is the paper's (sec. 3, eq. kkl_observer).

    The filter's state is ``z = [z_y, z_u of the first input, ...]``, of size ``nz * (1 + nu)``.

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

    A: np.ndarray
    B: np.ndarray
    dt: float
    nu: int = 0

    def __post_init__(self) -> None:
        A, B = np.asarray(self.A, dtype=float), np.asarray(self.B, dtype=float)
        if A.ndim != 2 or A.shape[0] != A.shape[1] or B.ndim != 2 or len(B) != len(A):
            raise ValueError(f"A must be (nz, nz) and B (nz, ny), got {A.shape} and {B.shape}")
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise ValueError("A and B must be finite")
        if not 0 < self.dt < np.inf:
            raise ValueError(f"dt must be a positive, finite number of seconds, got {self.dt!r}")
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

        s = poles * self.dt
        late = (np.expm1(s) - s) / (poles * s)  # integral of e^{poles (dt - t)} t / dt over [0, dt]
        hold = np.expm1(s) / poles  # ... of e^{poles (dt - t)}
        blocks = 1 + self.nu
        nz, ny = B.shape
        transition = np.kron(np.eye(blocks), function_of_A(np.exp(s)))
        early_y, late_y = (np.zeros((blocks * nz, ny)) for _ in range(2))
        early_y[:nz] = function_of_A(hold - late) @ B
        late_y[:nz] = function_of_A(late) @ B
        held_u = np.kron(np.eye(blocks, self.nu, -1), function_of_A(hold) @ B.sum(1, keepdims=True))
        equilibrium = np.zeros((blocks * nz, ny))
        equilibrium[:nz] = -np.linalg.solve(A, B)
        for name, value in {
            "A": A,
            "B": B,
            "transition": transition,
            "early_y": early_y,
            "late_y": late_y,
            "equilibrium": equilibrium,
            "_update": np.hstack([transition, early_y, held_u, late_y]).T.copy(),
        }.items():
            object.__setattr__(self, name, value)

    transition: np.ndarray = None  # type: ignore[assignment]
    early_y: np.ndarray = None  # type: ignore[assignment]
    late_y: np.ndarray = None  # type: ignore[assignment]
    equilibrium: np.ndarray = None  # type: ignore[assignment]
    _update: np.ndarray = None  # type: ignore[assignment]

    @property
    def size(self) -> int:
        """Number of components of the filter's state, nz * (1 + nu)."""
        return len(self.transition)

    def start(self, y0: np.ndarray) -> np.ndarray:
        """The state that a constant output y0, (..., ny), would have led to: z_y = -A^-1 B y0, z_u = 0."""
        z: np.ndarray = y0 @ self.equilibrium.T
        return z

    def advance(self, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray) -> np.ndarray:
        """The state one sample later.

        z : (..., size); y, y_next : (..., ny), the outputs at both ends; u : (..., nu), held between them.
        """
        z_next: np.ndarray = np.concatenate((z, y, u, y_next), axis=-1) @ self._update
        return z_next
