"""What is known of each shipped system beyond its equations: a module for each, found by the system's name.

docs/guides/own_system.md says how to add one.
"""

import numpy as np

from kkl_gym.loading import load_function
from kkl_gym.system import System
from training.systems import lorenz, reverse_duffing, rossler, van_der_pol
from training.systems.profile import Profile
from training.systems.task import Task, control_task
from training.trajectories.controllers import Controller
from training.trajectories.policy import checked_policy

PROFILES: dict[str, Profile] = {
    "reverse_duffing": reverse_duffing.PROFILE,
    "van_der_pol": van_der_pol.PROFILE,
    "rossler": rossler.PROFILE,
    "lorenz": lorenz.PROFILE,
}


def profile(system: System) -> Profile:
    """What is known of a system."""
    return PROFILES.get(system.name, Profile())


def controller(system: System) -> Controller:
    """A feedback that brings a system to its target.

    It is the saturated linear-quadratic regulator, or the law that the system's profile names.
    """
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs to control it by")
    return profile(system).controller(system)


def named_policy(system: System, name: str) -> Controller:
    """A policy under which motions of a system are simulated."""
    if name != "controller":
        return checked_policy(load_function(name), system, name)
    try:
        return checked_policy(controller(system), system, name)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"no linear-quadratic regulator holds {system.name} at its target {system.target} ({error}): set the "
            "target, or give a policy of your own as script.py:function"
        ) from error


__all__ = ["PROFILES", "Profile", "Task", "control_task", "controller", "named_policy", "profile"]
