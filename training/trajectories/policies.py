"""Policies, which turn states into actions: the linear-quadratic regulator, and functions of users."""

import hashlib
import json
from collections.abc import Callable

import numpy as np
import scipy

from kkl_gym.system import System
from kkl_gym.user_lines import user_line
from training.trajectories.equations import linearised

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
    return lambda x: np.clip(-(x - target) @ K.T / u_max, -1.0, 1.0)


def checked_policy(policy: Controller, system: System, name: str) -> Controller:
    """Raise ValueError unless a policy's actions on some states are valid; the returned one checks their shape."""
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs for the policy {name!r} to act by")

    def act(x: np.ndarray) -> np.ndarray:
        try:
            actions = np.asarray(policy(x), dtype=float)
        except Exception as error:  # whatever a user's function does wrong
            line = user_line(error)
            raise ValueError(
                f"the policy {name!r} fails on states of shape {x.shape}: {type(error).__name__}: {error}"
                + (f" ({line})" if line else "")
            ) from error
        if actions.shape != (len(x), system.nu):
            raise ValueError(
                f"the policy {name!r} must turn states of shape {x.shape} into actions of shape "
                f"{(len(x), system.nu)}, got {actions.shape}"
            )
        return actions

    x = _states(system)
    actions = act(x)
    wrong = ~(np.abs(actions) <= 1.0).all(-1)
    if wrong.any():
        at = int(wrong.argmax())
        raise ValueError(
            f"the policy {name!r} must give actions in [-1, 1], which stand for inputs up to u_max = {system.u_max}; "
            f"at x = {x[at].tolist()} it gives {actions[at].tolist()}"
        )
    return act


def policy_fingerprint(policy: Controller, system: System) -> str:
    """Hash of a policy's actions on some states."""
    actions = np.round(np.asarray(policy(_states(system)), dtype=float), 6)  # the same on every machine
    return hashlib.sha256(json.dumps(actions.tolist()).encode()).hexdigest()[:16]


def _states(system: System) -> np.ndarray:
    return system.draw_starts(np.random.default_rng(0), 20)
