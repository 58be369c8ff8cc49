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
    """What is known of a system.

    Parameters
    ----------
    system : System
        Any.

    Returns
    -------
    Profile
        That of a shipped system by its name, else the defaults.
    """
    return PROFILES.get(system.name, Profile())


def controller(system: System) -> Controller:
    """Make a stabilising feedback: the saturated linear-quadratic regulator, or the law that the profile names.

    Parameters
    ----------
    system : System
        What is to be held at its target.

    Returns
    -------
    callable
        States (n, nx) in, actions (n, nu) in [-1, 1] out.

    Raises
    ------
    ValueError
        If the system has no inputs.
    numpy.linalg.LinAlgError
        If its linearisation cannot be stabilised.
    """
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs to control it by")
    return profile(system).controller(system)


__all__ = ["PROFILES", "ControlTask", "Profile", "controller", "profile"]
