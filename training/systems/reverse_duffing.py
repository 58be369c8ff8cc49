"""Reverse Duffing: what is chosen for it, and its controller."""

import numpy as np

from kkl_gym.system import System
from training.spectrum import evenly_spaced
from training.systems.profile import Profile
from training.systems.task import ControlTask
from training.trajectories.controllers import Controller


def homogeneous(system: System) -> Controller:
    """u = x1 - 2 (x2 + cbrt(x1)) for x1' = x2^3, x2' = -x1 + u, cut at the input bound.

    The linearisation at the origin cannot be stabilised, so there is no linear law. With the drift's -x1 cancelled, x2
    follows -cbrt(x1), on which x1' = -x1.
    """
    (u_max,) = system.u_max

    def act(x: np.ndarray) -> np.ndarray:
        x1, x2 = x[:, :1], x[:, 1:]
        action: np.ndarray = np.clip((x1 - 2.0 * (x2 + np.cbrt(x1))) / u_max, -1.0, 1.0)
        return action

    return act


PROFILE = Profile(
    eigenvalues=evenly_spaced(13, -0.2, -8.0),
    controller=homogeneous,
    fault_deadline=10.0,  # about a period at amplitude 1
    # Marginally stable: whoever does not know the state cannot take energy out.
    task=ControlTask("reverse_duffing", period=0.1),
    algorithm="sac",
    agent_observer="reverse_duffing-closed-loop-v1",  # fitted in closed loop, where that helped
    printed={"spinn": 1.96, "ae": 55.4, "dmf": 46.2, "node": 159.8},
)
