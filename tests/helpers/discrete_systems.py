"""Systems in discrete time."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from linear_system import F, Oscillator
from scipy.linalg import expm

import kkl_gym.elementary as e
from kkl_gym import System

DT = 0.02
PHI = expm(F * DT)
GAMMA = np.linalg.solve(F, PHI - np.eye(2)) @ [0.0, 1.0]  # effect of an input that is constant over a sample


@dataclass(frozen=True)
class Sampled(System):
    """The oscillator from sample to sample, in closed form."""

    name: ClassVar[str] = "sampled"
    X: ClassVar = Oscillator.X
    bounds: ClassVar = Oscillator.bounds
    u_max: ClassVar = Oscillator.u_max
    dt: ClassVar = DT

    def step(self, x, u):
        return [
            float(row[0]) * x[0] + float(row[1]) * x[1] + float(gamma) * u[0]
            for row, gamma in zip(PHI, GAMMA, strict=True)
        ]

    def h(self, x):
        return (x[0],)


@dataclass(frozen=True)
class Turning(System):
    """A rotation by omega dt per sample; the output is x1 times a gain."""

    omega: float = 1.0
    gain: float = 1.0

    name: ClassVar[str] = "turning"
    X: ClassVar = ((-1, 1), (-1, 1))
    bounds: ClassVar = ((-9, 9), (-9, 9))
    u_max: ClassVar = (0.5,)
    dt: ClassVar = 0.05

    def step(self, x, u):
        c, s = e.cos(self.omega * self.dt), e.sin(self.omega * self.dt)
        return c * x[0] + s * x[1], c * x[1] - s * x[0] + self.dt * u[0]

    def h(self, x):
        return (self.gain * x[0],)


@dataclass(frozen=True)
class Henon(System):
    """Henon's map with an input, chaotic: x1+ = 1 - a x1^2 + x2 + u, x2+ = b x1, y = x1."""

    a: float = 1.4
    b: float = 0.3

    name: ClassVar[str] = "henon"
    X: ClassVar = ((-0.5, 0.5), (-0.15, 0.15))
    bounds: ClassVar = ((-3, 3), (-1, 1))
    u_max: ClassVar = (0.02,)
    dt: ClassVar = 1.0

    def step(self, x, u):
        return 1.0 - self.a * x[0] * x[0] + x[1] + u[0], self.b * x[0]

    def h(self, x):
        return (x[0],)
