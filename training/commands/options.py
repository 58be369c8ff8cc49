"""Options that several commands share: observers, their systems, levels of noise, parameters, how a run goes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tyro.constructors import PrimitiveConstructorSpec

from kkl_gym import ENV_IDS, OWN_ID, SYSTEMS, get_system
from kkl_gym.system import System
from observers import Artifact, shipped
from observers.names import resolve
from training.evaluation.levels import Level, read_level
from training.presets import named_policy
from training.trajectories.parameters import EVERY, blind, with_bias
from training.trajectories.policies import Controller

Pairs = tuple[tuple[str, Any], ...]  # of the words NAME=VALUE behind an option
Repeated = tuple[Pairs, ...]  # of an option that may be given several times; merged makes one mapping of them


def words(read: Callable[[str], Any], metavar: str) -> PrimitiveConstructorSpec[Any]:
    """An option that takes several words, of which a function reads each."""
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=metavar,
        instance_from_str=lambda texts: tuple(map(read, texts)),
        is_instance=lambda value: True,
        str_from_instance=lambda values: list(map(str, values or ())),
    )


def read_number(text: str) -> tuple[str, float]:
    """Read a parameter, written as ``mu=3.3``."""
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise ValueError(f"{text!r} is no parameter with its value: write NAME=VALUE, as in mu=3.3") from None


def read_unknown(text: str) -> tuple[str, tuple[float, ...]]:
    """Read an unknown parameter, written as ``mu=1.5``, or with limits as ``mu=1.5:0.5:6``."""
    name, _, values = text.partition("=")
    try:
        numbers = tuple(float(value) for value in values.split(":"))
    except ValueError:
        numbers = ()
    if not name.strip() or len(numbers) not in (1, 3):
        raise ValueError(
            f"{text!r} is no unknown parameter: write NAME=VALUE, or NAME=VALUE:LOW:HIGH, as in mu=1.5:0.5:6"
        )
    return name.strip(), numbers


def read_half_width(text: str) -> tuple[str, float]:
    """Read how uncertain a parameter is, written as ``mu=0.1``; a number alone is for all parameters."""
    name, _, share = text.rpartition("=")
    try:
        return name.strip() or EVERY, float(share)
    except ValueError:
        raise ValueError(
            f"{text!r} is no uncertainty of a parameter: write NAME=SHARE, as in mu=0.1, or a number for all"
        ) from None


def merged(option: str, repeated: Iterable[Pairs]) -> dict[str, Any]:
    """The values of an option by name; ValueError if one has two."""
    names = [name for pairs in repeated for name, _ in pairs]
    if len({*names}) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"{option} names {', '.join(twice)} twice")
    return {name: value for pairs in repeated for name, value in pairs}


SYSTEM = "A shipped system (lorenz, Lorenz or KKLLorenz-v0), or yours: script.py, script.py:Class or module:Class."
SystemName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SYSTEM", help=SYSTEM)]
OneSystem = Annotated[
    tyro.conf.Positional[str | None],
    tyro.conf.arg(metavar="[SYSTEM]", help=SYSTEM, help_behavior_hint="(default: all four that ship)"),
]
OwnSystem = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="CLASS",
        help="The system of observers that were made for one of your own, as script.py:Class or module:Class.",
        help_behavior_hint="",
    ),
]
OneObserver = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="MAP",
        help="An observer for that system: a shipped map or a .safetensors file.",
        help_behavior_hint="(default: the newest that ships for it)",
    ),
]
Observers = Annotated[
    tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[MAP [MAP ...]]", help_behavior_hint="")
]
Parameters = Annotated[
    tuple[Annotated[Pairs, words(read_number, "NAME=VALUE")], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(
        help="Physical parameters that differ from the system's defaults, as in rho=30.",
        help_behavior_hint="(default: none)",
    ),
]
Plant = Annotated[
    tuple[Annotated[Pairs, words(read_number, "NAME=VALUE")], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(help_behavior_hint="(default: the observer's own)"),
]
Unknowns = Annotated[
    tuple[Annotated[Pairs, words(read_unknown, "NAME=VALUE[:LOW:HIGH]")], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(help_behavior_hint=""),
]
HalfWidths = Annotated[
    tuple[Annotated[Pairs, words(read_half_width, "NAME=SHARE")], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(help_behavior_hint="(default: none)"),
]
# A level is written as a number for all outputs, or as one for each with commas between them. Defaults are in words.
NoiseLevel = Annotated[
    Level | None,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="LEVEL",
        instance_from_str=lambda texts: read_level(texts[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda level: [str(level)],
    ),
    tyro.conf.arg(help_behavior_hint="(default: the system's own)"),
]
NoiseLevels = Annotated[
    tuple[Level, ...] | None,
    words(read_level, "LEVEL [LEVEL ...]"),
    tyro.conf.arg(help_behavior_hint="(default: 0 and the system's own)"),
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


@dataclass(frozen=True)
class RunOptions:
    """The folder of a training, and how it runs."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="(default: runs/NAME)")] = None
    """Where all files are written."""
    resume: bool = False
    """Go on from the checkpoints in the folder, if there are any."""
    threads: int = 1
    """CPU threads. More than one hardly help networks of the fast preset's size."""

    def start(self) -> None:
        """Set torch's threads."""
        import torch  # which takes longer to import than all the rest

        if self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        torch.set_num_threads(self.threads)


def read_observers(names: Sequence[str], own_system: str | None) -> list[tuple[str, Artifact, System]]:
    """Read observers and find their systems."""
    if not names:
        raise ValueError(f"name an observer; shipped: {', '.join(shipped()) or 'none'}")
    artifacts = [(name, Artifact.read(resolve(name))) for name in names]
    return [(name, artifact, model_of(artifact, own_system)) for name, artifact in artifacts]


@dataclass(frozen=True)
class Shown:
    """An environment that a command shows, and its observer; None for the one that ships for the system."""

    label: str
    env_id: str
    options: Mapping[str, Any]
    system: System
    observer: str | None

    @property
    def observed(self) -> bool:
        """Whether there is an observer, named or shipped."""
        return self.observer is not None or self.system.name in shipped()


def shown(system: str | None, observer: str | None) -> list[Shown]:
    """Find the environments to show: those that ship, or one that is named."""
    if system is None:
        if observer is not None:
            raise ValueError(f"name the system that the observer {observer} is for")
        return [Shown(env_id, env_id, {}, get_system(name), None) for name, env_id in ENV_IDS.items()]
    if observer is None:
        found, options = get_system(system), {}
    else:
        artifact = Artifact.read(resolve(observer))
        found, options = system_of(artifact, system), {"dt": artifact.filter.dt}
    label = ENV_IDS[found.name] if type(found) in SYSTEMS.values() else found.name
    return [Shown(label, OWN_ID, {"system": found, **options}, found, observer)]


def read_policy(artifact: Artifact, system: System, own_policy: str | None) -> Controller | None:
    """Find the policy under which an observer is to be judged: one like that of its training."""
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
    found = named_policy(system, name)
    return blind(found, system.nx) if np.any(artifact.training.get("bias", 0.0)) else found


def system_of(artifact: Artifact, given: str | None) -> System:
    """The system that an artifact was made for, checked against it."""
    artifact.require_system()
    if given is None and artifact.system not in SYSTEMS:
        raise ValueError(f"{artifact.system!r} is no shipped system: name its class with --system script.py:Class")
    base = get_system(given or artifact.system)
    if base.name == artifact.system and set(artifact.parameters) == set(base.parameters):
        base = base.replace(artifact.parameters)
    artifact.check(base.name, base.parameters, dt=artifact.filter.dt, ny=base.ny, nu=base.nu)
    return base


def model_of(artifact: Artifact, given: str | None) -> System:
    """The system of an artifact, with the biases that it estimates as further states."""
    base, bias = system_of(artifact, given), artifact.training.get("bias", 0.0)
    return with_bias(base, bias) if np.any(bias) else base
