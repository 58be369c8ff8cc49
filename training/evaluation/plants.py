"""Plants that are not the model: the same equations with other parameters."""

from kkl_gym.system import System
from observers.checks import is_finite, shown


def off_by(system: System, share: float) -> System:
    """The same system with every parameter larger by a share of itself."""
    if not is_finite(share):
        raise ValueError(f"the error of the parameters must be a finite number, as 0.1 is, got {shown(share)}")
    if not system.parameters:
        raise ValueError(f"{system.name} has no parameters that could be off")
    return system.replace({name: (1.0 + share) * value for name, value in system.parameters.items()})


def show_parameters(system: System) -> str:
    """For titles and tables: ``mu=3.3``, with spaces between several."""
    return " ".join(f"{name}={value:g}" for name, value in system.parameters.items())
