"""Plants that are not the model: the same equations with other parameters."""

from kkl_gym.system import System
from observers.checks import is_finite, shown


def off_by(system: System, share: float) -> System:
    """The same system with every parameter larger by a share of itself.

    Parameters
    ----------
    system : System
        Any system with parameters.
    share : float
        0.1 makes each of them 10 % larger, -0.1 makes them 10 % smaller.

    Returns
    -------
    System
        An instance of the same class.

    Raises
    ------
    ValueError
        If the share is no finite number, or the system has no parameters.
    """
    if not is_finite(share):
        raise ValueError(f"the error of the parameters must be a finite number, as 0.1 is, got {shown(share)}")
    if not system.parameters:
        raise ValueError(f"{system.name} has no parameters that could be off")
    return system.replace({name: (1.0 + share) * value for name, value in system.parameters.items()})


def show_parameters(system: System) -> str:
    """For titles and tables: ``mu=3.3``, with spaces between several."""
    return " ".join(f"{name}={value:g}" for name, value in system.parameters.items())
