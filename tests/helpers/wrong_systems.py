"""Systems whose equations fail when they are evaluated on anything but floats."""

import math

from kkl_gym import System


class Late(System):
    """Uses functions of ``math``, which take floats only."""

    name = "late"
    X = ((0.5, 1.0), (-2.0, 2.0))
    bounds = ((-9.0, 9.0), (-9.0, 9.0))
    u_max = (1.0,)
    G = ((0.0,), (1.0,))

    def f(self, x):
        return x[1], -math.sin(x[0])

    def h(self, x):
        return (math.cos(x[0]),)

    def rate(self, x):
        return 1.0


class Branching(Late):
    """Uses an `if` on a state, which works for floats only."""

    name = "branching"

    def f(self, x):
        if x[0] > 0:
            return x[1], 0.0
        return x[1], 1.0


class Wide(Late):
    """Returns one component too many."""

    name = "wide"

    def f(self, x):
        return x[1], x[0], 0.0
