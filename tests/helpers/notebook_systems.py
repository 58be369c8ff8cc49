"""Systems defined as in the cells of a notebook: no other process can import them."""

from dataclasses import dataclass

from kkl_gym import System


def springs():
    """A plain class and a frozen dataclass."""

    class Spring(System):
        name = "spring"
        X, bounds = ((-1.0, 1.0), (-1.0, 1.0)), ((-9.0, 9.0), (-9.0, 9.0))

        def f(self, x):
            return x[1], -x[0]

        def h(self, x):
            return (x[0],)

    @dataclass(frozen=True)
    class Stiffer(Spring):
        k: float = 2.0
        name = "stiffer"

        def f(self, x):
            return x[1], -self.k * x[0]

    return Spring, Stiffer
