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
from training.systems import named_policy
from training.trajectories.controllers import Controller

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
Seconds = Annotated[float | None, tyro.conf.arg(metavar="SECONDS", help_behavior_hint="(default: the system's own)")]
OwnPolicy = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="FUNCTION",
        help="The policy of observers that were trained under one of your own, as script.py:function or "
        "module:function. Those that were trained under the system's own controller need no option.",
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


def read_policy(artifact: Artifact, system: System, own_policy: str | None) -> Controller | None:
    """Find the policy under which an observer is to be judged: one like that of its training.

    Parameters
    ----------
    artifact : Artifact
        The observer. A file never makes code run that is named in it alone.
    system : System
        What it was made for.
    own_policy : str or None
        What the user names: as for :attr:`training.config.Config.policy`.

    Returns
    -------
    callable or None
        None for an observer that was trained without one, unless the user names one.

    Raises
    ------
    ValueError
        If the observer was trained under a policy of the user's that is not named, takes in no inputs, or the policy
        is none.
    """
    trained = artifact.training.get("policy")
    if own_policy is None and trained is not None and trained != "controller":
        raise ValueError(
            f"this observer was trained under the policy {trained!r}, which acts in its tests too: name it yourself, "
            "--policy script.py:function"
        )
    name = own_policy or trained
    if name is None:
        return None
    if not artifact.nu:
        raise ValueError(f"the policy {name!r} needs an observer that takes in inputs; this one takes none")
    return named_policy(system, name)
