"""Systems whose equations fail where they are evaluated on something else than floats."""

import math

from kkl_gym import System


class Late(System):
    """Functions of ``math``, which take floats alone."""

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
    """A decision, which floats alone allow."""

    name = "branching"

    def f(self, x):
        if x[0] > 0:
            return x[1], 0.0
        return x[1], 1.0


class Wide(Late):
    """A component too many."""

    name = "wide"

    def f(self, x):
        return x[1], x[0], 0.0
