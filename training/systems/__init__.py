"""What is known of each shipped system beyond its equations: a module for each, found by the system's name.

docs/adding_a_system.md says how to add one.
"""

from kkl_gym.system import System
from training.systems import lorenz, reverse_duffing, rossler, van_der_pol
from training.systems.profile import Profile
from training.systems.task import ControlTask
from training.trajectories.controllers import Controller

PROFILES: dict[str, Profile] = {
    "reverse_duffing": reverse_duffing.PROFILE,
    "van_der_pol": van_der_pol.PROFILE,
    "rossler": rossler.PROFILE,
    "lorenz": lorenz.PROFILE,
}


def profile(system: System) -> Profile:
    """What is known of a system; of one that is not shipped, the defaults."""
    return PROFILES.get(system.name, Profile())


def controller(system: System) -> Controller:
    """A stabilising feedback: states (n, nx) in, actions (n, nu) in [-1, 1] out.

    The saturated linear-quadratic regulator, or the law that the system's profile names.

    Raises ValueError if the system has no inputs, numpy.linalg.LinAlgError if its linearisation cannot be stabilised.
    """
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs to control it by")
    return profile(system).controller(system)


__all__ = ["PROFILES", "ControlTask", "Profile", "controller", "profile"]
