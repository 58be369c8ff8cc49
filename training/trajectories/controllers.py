"""Classical state feedback: what an agent is measured against, and what drives closed-loop training data."""

from collections.abc import Callable

import numpy as np
import scipy

from kkl_gym.system import System
from training.trajectories.derivatives import linearised

Controller = Callable[[np.ndarray], np.ndarray]
"""States (n, nx) in, actions (n, nu) in [-1, 1] out."""

INPUT_WEIGHT = 0.1  # beside a weight of 1 on the states, both in units of their typical sizes


def linear_quadratic(system: System) -> Controller:
    """Linear-quadratic regulator of the linearisation at the target, u = -K (x - target) cut at the input bounds.

    Its weights are 1/scale^2 on the state and INPUT_WEIGHT/u_max^2 on the input, on each step in discrete time.
    """
    target, u_max = np.array(system.target), np.array(system.u_max)
    A, B, _ = linearised(system, system.target)
    Q, R = np.diag(1.0 / np.square(system.scale)), np.diag(INPUT_WEIGHT / u_max**2)
    if system.discrete:
        P = scipy.linalg.solve_discrete_are(A, B, Q, R)
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    else:
        K = np.linalg.solve(R, B.T @ scipy.linalg.solve_continuous_are(A, B, Q, R))

    def act(x: np.ndarray) -> np.ndarray:
        action: np.ndarray = np.clip(-(x - target) @ K.T / u_max, -1.0, 1.0)
        return action

    return act
