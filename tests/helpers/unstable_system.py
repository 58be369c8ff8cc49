"""An unstable plant: random inputs do not keep it within its bounds."""

from dataclasses import dataclass
from typing import ClassVar

from kkl_gym import System


@dataclass(frozen=True)
class Falling(System):
    """x1' = x2, x2' = 4 x1 + u, y = x1: an inverted pendulum, linearised."""

    name: ClassVar[str] = "falling"
    X: ClassVar = ((-0.3, 0.3), (-0.5, 0.5))
    bounds: ClassVar = ((-2, 2), (-5, 5))
    u_max: ClassVar = (5.0,)
    G: ClassVar = ((0.0,), (1.0,))

    def f(self, x):
        return x[1], 4.0 * x[0]

    def h(self, x):
        return (x[0],)
