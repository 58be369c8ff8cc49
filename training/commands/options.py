"""What several commands ask for: observers, the system of one's own that they are for, levels of noise, durations."""

from collections.abc import Sequence
from typing import Annotated

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from kkl_gym.system import System
from kkl_gym.systems import system_of
from observers import Artifact, shipped
from observers.artifact import resolve
from training.evaluation.levels import Level, read_level

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
# A level is written as a number for all outputs, or as one for each with commas between them. Defaults are in words.
NoiseLevel = Annotated[
    Level | None,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="LEVEL",
        instance_from_str=lambda words: read_level(words[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda level: [str(level)],
    ),
    tyro.conf.arg(aliases=["--noise"], help_behavior_hint="(default: the system's own)"),
]
NoiseLevels = Annotated[
    tuple[Level, ...] | None,
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="LEVEL [LEVEL ...]",
        instance_from_str=lambda words: tuple(map(read_level, words)),
        is_instance=lambda value: True,
        str_from_instance=lambda levels: [str(levels)],
    ),
    tyro.conf.arg(aliases=["--noise"], help_behavior_hint="(default: 0 and the system's own)"),
]
Duration = Annotated[float | None, tyro.conf.arg(metavar="SECONDS", help_behavior_hint="(default: the system's own)")]


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
