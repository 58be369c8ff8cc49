"""What several commands ask for: observers by name or file, and the system of one's own that they are for."""

from collections.abc import Sequence
from typing import Annotated

import tyro

from kkl_gym.system import System
from kkl_gym.systems import system_of
from observers import Artifact, shipped
from observers.artifact import resolve

SystemName = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(metavar="SYSTEM", help="A shipped system, or a class of yours as script.py:Class or module:Class."),
]
Parameters = Annotated[
    dict[str, float],
    tyro.conf.arg(
        help="Physical parameters that differ from the system's defaults, as in: --parameters rho 30.",
        help_behavior_hint="(default: none)",
    ),
]
Observers = Annotated[
    tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[MAP [MAP ...]]", help_behavior_hint="")
]
OwnSystem = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="CLASS",
        help="The system of observers that were made for one of your own, as script.py:Class or module:Class.",
        help_behavior_hint="",
    ),
]


def read_observers(names: Sequence[str], own_system: str | None) -> list[tuple[str, Artifact, System]]:
    """Read observers and find their systems.

    Parameters
    ----------
    names : sequence of str
        Shipped maps, or ``.safetensors`` files.
    own_system : str or None
        Class of the observers' system, unless it ships.

    Returns
    -------
    list of (str, Artifact, System)
        Each name with what is behind it.

    Raises
    ------
    ValueError
        If no observer is named, one cannot be read, or it does not fit the system.
    """
    if not names:
        raise ValueError(f"name an observer; shipped: {', '.join(shipped()) or 'none'}")
    artifacts = [(name, Artifact.read(resolve(name))) for name in names]
    return [(name, artifact, system_of(artifact, own_system)) for name, artifact in artifacts]
