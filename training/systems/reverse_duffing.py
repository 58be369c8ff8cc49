"""Reverse Duffing: the spectrum of its observer, its controller and control task, and why they were chosen.

Its equation is :class:`kkl_gym.systems.ReverseDuffing`.
"""

import numpy as np

from kkl_gym.system import System
from training.spectrum import evenly_spaced
from training.systems.profile import Profile
from training.systems.task import control_task
from training.trajectories.controllers import Controller


def homogeneous(system: System) -> Controller:
    """The feedback u = b x1 - 2 (x2 + cbrt(a x1)), cut at the input bound, for x1' = a x2^3, x2' = -b x1 + u.

    The linearisation at the origin cannot be stabilised, so there is no linear law. With the drift's -b x1 cancelled,
    x2 follows -cbrt(a x1), on which x1' = -a^2 x1.
    """
    (u_max,) = system.u_max
    a, b = (system.parameters[name] for name in ("a", "b"))

    def act(x: np.ndarray) -> np.ndarray:
        x1, x2 = x[:, :1], x[:, 1:]
        action: np.ndarray = np.clip((b * x1 - 2.0 * (x2 + np.cbrt(a * x1))) / u_max, -1.0, 1.0)
        return action

    return act


PROFILE = Profile(
    eigenvalues=evenly_spaced(13, -0.2, -8.0),
    # The paper's: no two of its motions part or fall together.
    spinn_settings={"eigenvalues": tuple(np.linspace(-1.5, -3.0, 5).tolist())},
    controller=homogeneous,
    fault_deadline=10.0,  # about a period at amplitude 1
    # Marginally stable: whoever does not know the state cannot take energy out.
    task=control_task("reverse_duffing", period=0.1),
    algorithm="sac",
    printed={"spinn": 1.96, "ae": 55.4, "dmf": 46.2, "node": 159.8},
)
