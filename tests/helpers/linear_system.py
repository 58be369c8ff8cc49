"""A linear system on which everything is known in closed form."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg import solve_sylvester

from kkl_gym import System

F = np.array([[0.0, 1.0], [-1.0, 0.0]])
C = np.array([[1.0, 0.0]])


@dataclass(frozen=True)
class Oscillator(System):
    """x1' = x2, x2' = -x1 + u, y = x1: linear and neither growing nor decaying."""

    name: ClassVar[str] = "oscillator"
    X: ClassVar = ((-1, 1), (-1, 1))
    bounds: ClassVar = ((-30, 30), (-30, 30))
    u_max: ClassVar = (0.5,)
    G: ClassVar = ((0.0,), (1.0,))

    def f(self, x):
        return x[1], -x[0]

    def h(self, x):
        return (x[0],)


@dataclass(frozen=True)
class Autonomous(Oscillator):
    """The oscillator without its input."""

    name: ClassVar[str] = "autonomous"
    u_max: ClassVar[tuple[float, ...]] = ()
    G: ClassVar[tuple[tuple[float, ...], ...]] = ()


def sylvester(A, B):
    """M with T(x) = M x: M F = A M + B C."""
    return solve_sylvester(-A, F, B @ C)
