"""The eigenvalues of A: how they are spaced, what others take, and the filter that they make."""

from dataclasses import dataclass

import numpy as np
import scipy

from kkl_gym.system import System
from observers import LinearFilter

FASTEST_MODE = 0.5  # bound of |eigenvalue| * dt: a faster mode holds no more than the last samples


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues of A for each output."""

    eigenvalues: tuple[float, ...] = ()
    pairs: tuple[tuple[float, float], ...] = ()

    @property
    def modes(self) -> int:
        """Their number."""
        return len(self.eigenvalues) + 2 * len(self.pairs)

    @property
    def poles(self) -> np.ndarray:
        """All eigenvalues, complex, (modes,)."""
        above = [complex(a, w) for a, w in self.pairs]
        return np.array([*map(complex, self.eigenvalues), *above, *np.conj(above)])

    @property
    def A(self) -> np.ndarray:
        """A for one output, (modes, modes): real eigenvalues on the diagonal, then a block [[a, w], [-w, a]] a pair."""
        return np.asarray(scipy.linalg.block_diag(*self.eigenvalues, *([[a, w], [-w, a]] for a, w in self.pairs)))

    def filter(self, ny: int, dt: float, nu: int = 0) -> LinearFilter:
        """The filter with these modes for each output, driven by B = 1."""
        A = self.A
        return LinearFilter(np.kron(np.eye(ny), A), np.kron(np.eye(ny), np.ones((len(A), 1))), dt, nu)


def evenly_spaced(n: int, slowest: float, fastest: float) -> tuple[float, ...]:
    """Space real eigenvalues evenly in the logarithm."""
    return tuple((-np.geomspace(-slowest, -fastest, n)).tolist())


def papers_spectrum(system: System) -> tuple[float, ...]:
    """2 nx + 1 eigenvalues in [-3, -1.5] (paper, sec. 8), in one over the seconds of the system's pace."""
    return tuple((np.linspace(-1.5, -3.0, 2 * system.nx + 1) / system.pace).tolist())
