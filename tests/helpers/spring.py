"""A plant for tests of identification."""

from dataclasses import dataclass
from typing import ClassVar

from kkl_gym.system import System


@dataclass(frozen=True)
class Spring(System):
    """A mass on a damped spring, driven by a force."""

    stiffness: float = 4.0
    damping: float = 0.3
    gain: float = 2.0

    name: ClassVar[str] = "spring"
    X: ClassVar = ((-1.0, 1.0), (-2.0, 2.0))
    bounds: ClassVar = ((-9.0, 9.0), (-30.0, 30.0))
    u_max: ClassVar = (1.0,)
    dt: ClassVar = 0.05

    def f(self, x):
        return x[1], -self.stiffness * x[0] - self.damping * x[1]

    def g(self, x):
        return (0.0,), (self.gain,)

    def h(self, x):
        return (x[0],)
