"""The equations of a Quanser Qube Servo 2 for qube.py, with several kinds of friction."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

import kkl_gym
from kkl_gym.elementary import cos, sin, tanh

KEPT = 0.1  # s, correlation time of the unknown torque


@dataclass(frozen=True)
class Qube(kkl_gym.System):
    """The device without motor input: x = (theta, alpha, theta', alpha'), alpha from upright, y = theta.

    The defaults are the published model, without dry friction and without the spring of the arm's cable.

    Lengths, masses and inertias are those of Quanser's script qube2_rotpen_param.m; the arm's inertia is that of a rod,
    mass length^2 / 12. The script's damping is much larger than in the runs of qube.py, so both damping coefficients
    are those of BlueRiverTech's quanser-openai-driver, file qube_simulator.py. The motor's terminals are open.
    """

    gravity: float = 9.81  # m/s^2
    arm_length: float = 0.085  # m
    arm_inertia: float = 5.72e-5  # kg m^2, 0.095 kg (0.085 m)^2 / 12
    arm_damping: float = 0.00027  # N m s
    arm_friction: float = 0.0  # N m
    arm_spring: float = 0.0  # N m/rad
    pendulum_mass: float = 0.024  # kg
    pendulum_length: float = 0.129  # m
    pendulum_inertia: float = 0.024 * 0.129**2 / 3  # kg m^2, about its joint
    pendulum_damping: float = 0.00005  # N m s
    pendulum_friction: float = 0.0  # N m
    arm_slip: float = 0.1  # rad/s, dry friction changes its sign between minus and plus this rate
    pendulum_slip: float = 0.8  # rad/s

    name: ClassVar[str] = "qube"
    state_names: ClassVar = ("theta in rad", "alpha in rad", "theta' in rad/s", "alpha' in rad/s")
    X: ClassVar = ((-1.5, 1.5), (0.0, 2 * np.pi), (-10.0, 10.0), (-25.0, 25.0))
    bounds: ClassVar = ((-50.0, 50.0), (-500.0, 500.0), (-100.0, 100.0), (-200.0, 200.0))

    def f(self, x):
        """Drift."""
        return self.moved(*x)

    def moved(self, theta, alpha, theta_dot, alpha_dot, torque=0.0):
        """Return the state's derivatives by Lagrange's equations of both angles; the torque acts on the arm, in N m."""
        half, sine, cosine = self.pendulum_length / 2, sin(alpha), cos(alpha)
        inertia = self.pendulum_inertia
        coupling = -self.pendulum_mass * self.arm_length * half
        m11 = self.arm_inertia + self.pendulum_mass * self.arm_length**2 + inertia * sine * sine
        m12, m22 = coupling * cosine, inertia
        r1 = coupling * sine * alpha_dot**2 - 2 * inertia * sine * cosine * theta_dot * alpha_dot
        r2 = inertia * sine * cosine * theta_dot**2 + self.pendulum_mass * self.gravity * half * sine
        r1 = r1 - self.arm_damping * theta_dot - self.arm_friction * tanh(theta_dot / self.arm_slip)
        r1 = r1 - self.arm_spring * theta + torque
        r2 = r2 - self.pendulum_damping * alpha_dot - self.pendulum_friction * tanh(alpha_dot / self.pendulum_slip)
        determinant = m11 * m22 - m12 * m12
        return theta_dot, alpha_dot, (m22 * r1 - m12 * r2) / determinant, (m11 * r2 - m12 * r1) / determinant

    def h(self, x):
        """Output."""
        return (x[0],)


@dataclass(frozen=True)
class BothAngles(Qube):
    """The model Qube with both angles measured, for the fit of its parameters to runs."""

    name: ClassVar[str] = "qube-both-angles"

    def h(self, x):
        """Outputs."""
        return x[0], x[1]


@dataclass(frozen=True)
class Sticking(BothAngles):
    """The model BothAngles, but the friction changes its sign so abruptly that small torques hardly move the arm."""

    arm_slip: float = 0.004
    pendulum_slip: float = 0.2

    name: ClassVar[str] = "qube-sticking"

    def rate(self, x):
        """A rate of change that gives each sample two substeps: they keep integration stable while the arm sticks."""
        return 150.0 + 0.0 * x[0]


@dataclass(frozen=True)
class Pushed(Sticking):
    """The model Sticking with y = theta and an unknown torque on the arm that stands for errors of the friction model.

    The torque, an Ornstein-Uhlenbeck process, is a fifth state, in units of 0.1 mN m.
    """

    name: ClassVar[str] = "qube-pushed"
    state_names: ClassVar = (*Qube.state_names, "torque in 0.1 mN m")
    X: ClassVar = (*Qube.X, (-3.0, 3.0))
    bounds: ClassVar = (*Qube.bounds, (-100.0, 100.0))

    def f(self, x):
        """Drift."""
        return *self.moved(*x[:4], 1e-4 * x[4]), -x[4] / KEPT

    def h(self, x):
        """Output."""
        return (x[0],)
