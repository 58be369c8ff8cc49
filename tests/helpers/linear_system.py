"""A linear system with closed forms of T, T_inv and its motion."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.linalg import solve_sylvester

from kkl_gym import System
from observers import MLP, Artifact, ForwardMap, InverseMap, LinearFilter
from training.maps.coordinates import stationary_covariance

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
    """The oscillator in mixed units: a temperature of 300 +- 20 K, and a concentration of (1 +- 1) 1e-3 mol/l."""

    name: ClassVar[str] = "reactor"
    state_names: ClassVar = ("T in K", "c in mol/l")
    X: ClassVar = ((280, 320), (0.0, 2e-3))
    bounds: ClassVar = ((200, 400), (-1e-2, 1e-2))
    dt: ClassVar = 0.05

    def f(self, x):
        return 2e4 * (x[1] - 1e-3), -5e-5 * (x[0] - 300)

    def h(self, x):
        return (x[0],)


@dataclass(frozen=True)
class TwoUnits(Oscillator):
    """The oscillator with an output in other units and a nonlinear output: y = [1000 x1, x1 + x2^2 / 2]."""

    name: ClassVar[str] = "two-units"

    def h(self, x):
        return 1000.0 * x[0], x[0] + 0.5 * x[1] ** 2


def sylvester(A, B, C=C):
    """M with T(x) = M x: M F = A M + B C."""
    return solve_sylvester(-A, F, B @ C)


REACTOR_OFFSET, REACTOR_SCALE = np.array([300.0, 1e-3]), np.array([20.0, 1e-3])  # K, mol/l


def reactor_observer(dt=0.05, offset=0.0, gain=1.0):
    """An artifact for the reactor, exact but for an `offset` of the temperature and a `gain` of the concentration.

    The filter gets y in K: T(x) = M (x - offset) / scale in units of 20 K, plus the filter's response to 300 K.
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


def exact_observer(dt=0.05, C=C, name="oscillator"):
    """An artifact for the oscillator with y = C x, T(x) = M x and T_inv(z) = L z with L M = 1, exact but for float32.

    L is the pseudo-inverse of M for one output; for several it is the left inverse that amplifies noise least.
    """
    ny = len(C)
    linear = LinearFilter(np.kron(np.eye(ny), np.diag([-1.0, -2.5, -4.0])), np.kron(np.eye(ny), np.ones((3, 1))), dt)
    M, nz = sylvester(linear.A, linear.B, C), 3 * ny
    zeros, ones = np.zeros, np.ones

    def network(matrix):
        return MLP([matrix.astype(np.float32)], [zeros(len(matrix), np.float32)], "tanh")

    root = np.eye(nz)
    if ny > 1:
        noise = stationary_covariance(linear).sum(0)
        root = np.linalg.inv(np.linalg.cholesky(noise + 1e-6 * np.trace(noise) * np.eye(nz)))
    L = np.linalg.pinv(root @ M) @ root
    inverse = InverseMap(network(L), ("z_y",), zeros(nz), np.eye(nz), zeros(nz), zeros(2), ones(2))
    scale = np.tile([0.5, 0.2, 0.1], ny)
    forward = ForwardMap(network(M / scale[:, None]), zeros(2), ones(2), zeros(nz), scale)
    return Artifact(linear, inverse, name, {}, forward=forward, C=C)
