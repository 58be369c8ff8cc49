"""A linear system on which everything is known in closed form."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg import solve_sylvester

from kkl_gym import System
from observers import MLP, Artifact, ForwardMap, InverseMap, LinearFilter

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


def exact_observer(dt=0.05):
    """An artifact for the oscillator with T(x) = M x and T_inv(z) = M^+ z, exact but for float32."""
    linear = LinearFilter(np.diag([-1.0, -2.5, -4.0]), np.ones((3, 1)), dt)
    M = sylvester(linear.A, linear.B)
    zeros, ones = np.zeros, np.ones

    def network(matrix):
        return MLP([matrix.astype(np.float32)], [zeros(len(matrix), np.float32)], "tanh")

    inverse = InverseMap(network(np.linalg.pinv(M)), ("z_y",), zeros(3), np.eye(3), zeros(3), zeros(2), ones(2))
    scale = np.array([0.5, 0.2, 0.1])
    forward = ForwardMap(network(M / scale[:, None]), zeros(2), ones(2), zeros(3), scale)
    return Artifact(linear, inverse, "oscillator", {}, forward=forward, C=C)
