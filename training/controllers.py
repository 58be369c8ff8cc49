"""Classical state feedback: what an agent is measured against, and what drives closed-loop training data."""

from collections.abc import Callable

import numpy as np
from scipy.linalg import solve_continuous_are

from kkl_gym.system import System
from training.derivatives import linearised

Controller = Callable[[np.ndarray], np.ndarray]
INPUT_WEIGHT = 0.1


def controller(system: System) -> Controller:
    """A stabilising feedback: states (n, nx) in, actions (n, nu) in [-1, 1] out.

    The saturated linear-quadratic regulator at the target with weights 1/scale^2 on the state and 0.1/u_max^2 on the
    input, and for reverse Duffing, whose linearisation cannot be stabilised, a homogeneous law.

    Raises ValueError if the system has no inputs, numpy.linalg.LinAlgError if its linearisation cannot be stabilised.
    """
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs to control it by")
    return homogeneous(system) if system.name == "reverse_duffing" else linear_quadratic(system)


def linear_quadratic(system: System) -> Controller:
    """u = -K (x - target), cut at the input bounds."""
    target, u_max = np.array(system.target), np.array(system.u_max)
    A, B, _ = linearised(system, system.target)
    Q, R = np.diag(1.0 / np.square(system.scale)), np.diag(INPUT_WEIGHT / u_max**2)
    K = np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R))

    def act(x: np.ndarray) -> np.ndarray:
        action: np.ndarray = np.clip(-(x - target) @ K.T / u_max, -1.0, 1.0)
        return action

    return act


def homogeneous(system: System) -> Controller:
    """u = x1 - 2 (x2 + cbrt(x1)) for x1' = x2^3, x2' = -x1 + u, cut at the input bound.

    With the drift's -x1 cancelled, x2 follows -cbrt(x1), on which x1' = -x1.
    """
    (u_max,) = system.u_max

    def act(x: np.ndarray) -> np.ndarray:
        x1, x2 = x[:, :1], x[:, 1:]
        action: np.ndarray = np.clip((x1 - 2.0 * (x2 + np.cbrt(x1))) / u_max, -1.0, 1.0)
        return action

    return act
