"""Motions under a policy: how plants are excited that no random input would hold within their bounds."""

import hashlib
import json
from collections.abc import Callable

import numpy as np

from kkl_gym.simulate import Step, simulate
from kkl_gym.system import System
from kkl_gym.user_lines import user_line
from training.trajectories.controllers import Controller
from training.trajectories.signals import random_signals

ERROR = (0.02, 0.5)  # of the states that a policy acts on, in multiples of the system's scale
EXPLORATION = 0.5  # largest amplitude of what is added to a policy's action, in input bounds
SIGNALS = ("steps", "sine")


def under_policy(
    system: System,
    policy: Controller,
    x0: np.ndarray,
    *,
    steps: int,
    dt: float,
    rng: np.random.Generator,
    own: np.ndarray,
    w: np.ndarray | None = None,
    report: Callable[[int], object] | None = None,
    plant: System | None = None,
    step: Step | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate trajectories under a policy that errs about the state and explores.

    A policy that acts on the true state would tell the observer, which filters the input, what it is to find out by
    itself. So each trajectory has an error of its own, which is added to the state before the policy sees it, and
    something of its own is added to the action. Both are held or swing, at random sizes and rates.

    Shapes: ``x0`` (n, nx), ``own`` (n,), ``w`` (steps, n, nx); returns ``x`` (steps + 1, n, nx), ``u`` (steps, n, nu).
    """
    n, u_max = len(x0), np.array(system.u_max)
    error = random_signals(system.scale, n, steps, dt=dt, pace=system.pace, rng=rng, kinds=SIGNALS)
    error *= np.exp(rng.uniform(np.log(ERROR[0]), np.log(ERROR[1]), n))[:, None]
    exploration = random_signals((1.0,) * system.nu, n, steps, dt=dt, pace=system.pace, rng=rng, kinds=SIGNALS)
    exploration *= EXPLORATION * rng.random(n)[:, None]
    error[:, own] = exploration[:, own] = 0.0
    u = np.zeros((steps, n, system.nu))

    def act(k: int, x: np.ndarray) -> np.ndarray:
        seen = np.where(np.isfinite(x), x, system.X_centre) + error[k]  # what has escaped may do anything
        action = policy(seen)
        unknown = ~np.isfinite(action).all(-1)
        if unknown.any():
            at = int(unknown.argmax())
            raise ValueError(f"the policy gives the action {action[at].tolist()} at x = {seen[at].tolist()}")
        u[k] = np.clip(action + exploration[k], -1.0, 1.0) * u_max
        return u[k]

    return simulate(plant or system, x0, steps, dt, u=act, w=w, report=report, step=step), u


def checked_policy(policy: Controller, system: System, name: str) -> Controller:
    """Raise an error unless a policy does on some states what a policy should, and wherever it fails later."""
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
    """What identifies a policy: a hash of its actions on some states."""
    actions = np.round(np.asarray(policy(_states(system)), dtype=float), 6)  # the same on every machine
    return hashlib.sha256(json.dumps(actions.tolist()).encode()).hexdigest()[:16]


def _states(system: System) -> np.ndarray:
    return system.draw_starts(np.random.default_rng(0), 20)
