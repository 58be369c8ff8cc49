"""A linear system on which everything is known in closed form."""

from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class TwoOutputs(Oscillator):
    """Both states are measured, with noise of different size."""

    name: ClassVar[str] = "two-outputs"
    measurement_noise: ClassVar = (0.1, 0.3)

    def h(self, x):
        return x[0], x[1]


@dataclass(frozen=True)
class Reactor(System):
    """The oscillator in mixed units: a temperature of 300 K, give or take 20, and 1e-3 mol/l, give or take as much."""

    name: ClassVar[str] = "reactor"
    state_names: ClassVar = ("T in K", "c in mol/l")
    X: ClassVar = ((280, 320), (0.0, 2e-3))
    bounds: ClassVar = ((200, 400), (-1e-2, 1e-2))
    dt: ClassVar = 0.05

    def f(self, x):
        return 2e4 * (x[1] - 1e-3), -5e-5 * (x[0] - 300)

    def h(self, x):
        return (x[0],)


def sylvester(A, B):
    """M with T(x) = M x: M F = A M + B C."""
    return solve_sylvester(-A, F, B @ C)


REACTOR_OFFSET, REACTOR_SCALE = np.array([300.0, 1e-3]), np.array([20.0, 1e-3])  # of the oscillator's states in it


def reactor_observer(dt=0.05, offset=0.0, gain=1.0):
    """An artifact for the reactor, exact but for an error of the temperature and a factor on the concentration.

    The filter is fed y in K: T(x) = M (x - offset) / scale in units of 20 K, and beside it what 300 K leave.
    """
    exact = exact_observer(dt)
    linear, inverse = exact.filter, exact.inverse
    z_offset = linear.equilibrium @ REACTOR_OFFSET[:1]
    inverse = replace(
        inverse,
        z_offset=z_offset,
        whiten=np.eye(3) / REACTOR_SCALE[0],
        x_offset=np.add(REACTOR_OFFSET, (offset, 0.0)),
        x_scale=np.multiply(REACTOR_SCALE, (1.0, gain)),
    )
    return Artifact(linear, inverse, "reactor", {}, C=C)


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
