"""Systems with kinks and jumps; together they use all functions of ``kkl_gym.elementary``."""

from dataclasses import dataclass

from kkl_gym import System
from kkl_gym.elementary import abs as absolute
from kkl_gym.elementary import atan2, clip, cos, exp, log, maximum, minimum, sign, sin, sqrt, tan, tanh, where


@dataclass(frozen=True)
class Chua(System):
    """Chua's circuit with its piecewise linear diode (T. Matsumoto, IEEE Trans. Circuits Syst. 31, 1984)."""

    alpha: float = 9.0
    beta: float = 14.0 + 2.0 / 7.0
    inner: float = -8.0 / 7.0
    outer: float = -5.0 / 7.0

    name = "chua"
    X = ((-2.5, 2.5), (-0.5, 0.5), (-4.0, 4.0))
    bounds = ((-20.0, 20.0), (-10.0, 10.0), (-40.0, 40.0))

    def f(self, x):
        diode = self.outer * x[0] + 0.5 * (self.inner - self.outer) * (abs(x[0] + 1.0) - abs(x[0] - 1.0))
        return self.alpha * (x[1] - x[0] - diode), x[0] - x[1] + x[2], -self.beta * x[1]

    def h(self, x):
        return (x[2],)


@dataclass(frozen=True)
class Slider(System):
    """A mass on a belt, with a dead zone, a stop, saturation, and friction that falls with speed."""

    stiffness: float = 4.0

    name = "slider"
    X = ((-2.0, 2.0), (-2.0, 2.0))
    bounds = ((-20.0, 20.0), (-20.0, 20.0))
    u_max = (1.0,)

    def f(self, x):
        place, speed = x
        slip = speed - 0.3
        friction = sign(slip) * (0.3 + 0.2 * exp(-absolute(slip))) + 0.1 * tanh(slip)
        stop = where((place > 1.0) & (speed > 0.0), 3.0 * log(1.0 + maximum(place - 1.0, 0.0)), 0.0)
        spring = where(place < -0.5, self.stiffness * (place + 0.5), minimum(place, 1.5))
        return clip(speed, -1.5, 1.5), -spring - friction - stop + 0.1 * cos(tan(0.1 * place)) * sqrt(
            1.0 + speed * speed
        )

    def g(self, x):
        return (0.0,), (where(x[0] > 0.0, 1.0, 0.5),)

    def h(self, x):
        return atan2(x[0], 2.0 + sin(x[1])), abs(x[1])

    def rate(self, x):
        return 5.0 + 0.0 * x[0]


SYSTEMS = [Chua(), Slider()]
