"""Networks that learn from outputs and equations."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from kkl_gym.elementary import sqrt
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.identification.consistency import ConsistencyProblem, filtered
from training.records import Record
from training.spectrum import Spectrum


@dataclass(frozen=True)
class Tank(System):
    """A tank that runs empty, below which its equation knows no numbers."""

    outlet: float = 0.3

    name: ClassVar[str] = "emptying_tank"
    X: ClassVar = ((0.5, 2.0),)
    bounds: ClassVar = ((0.0, 3.0),)
    u_max: ClassVar = (0.5,)
    G: ClassVar = ((1.0,),)
    dt: ClassVar = 0.05

    def f(self, x):
        return (-self.outlet * sqrt(x[0]),)

    def h(self, x):
        return (x[0],)


def test_states_beyond_the_bounds_have_gradients():
    """A network may begin with states for which the equations have no numbers, and must get away from there."""
    x = simulate(Tank(), np.array([[1.0]]), 100, 0.05)
    linear = Spectrum((-1.0, -2.0, -4.0)).filter(1, 0.05, 0)
    data = filtered([Record("run", 0.05 * np.arange(101), x[:, 0])], linear, 10)
    problem = ConsistencyProblem(Tank(), {"outlet": (0.05, 5.0)}, data, linear=linear, width=8, depth=1, batch=64)
    with torch.no_grad():
        for weights in problem.network.parameters():
            weights *= 30.0
    problem.loss(torch.Generator().manual_seed(0))["loss"].backward()
    assert all(bool(torch.isfinite(weights.grad).all()) for weights in problem.parameters())
