"""Systems with two inputs."""

from dataclasses import dataclass

from kkl_gym import System
from kkl_gym.elementary import cos, sin

GRAVITY = 9.81


@dataclass(frozen=True)
class Pendulum(System):
    """A state-dependent input matrix, constants of the class and of the module, and a numerical rate."""

    damping: float = 0.1

    length = 2
    name = "pendulum"
    X = ((-3, 3), (-3, 3))
    bounds = ((-30, 30), (-30, 30))
    u_max = (2, 3)

    def f(self, x):
        angle, speed = x
        return speed, -GRAVITY / self.length * sin(angle) - self.damping * speed * abs(speed)

    def g(self, x):
        return (0.0, 0.1), (cos(x[0]), 0.0)

    def h(self, x):
        return (x[0],)


class TwoInputs(Pendulum):
    """A constant input matrix and a rate in closed form."""

    name = "two_inputs"
    G = ((0.0, 0.1), (1.0, 0.7))
    g = System.g

    def rate(self, x):
        return 5.0 + abs(x[1])
