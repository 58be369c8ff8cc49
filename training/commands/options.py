"""Options that several commands share: observers, systems, noise levels, parameters, records, settings, folders."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_origin

import numpy as np
import tyro
from tyro.constructors import PrimitiveConstructorSpec

from kkl_gym import ENV_IDS, OWN_ID, SYSTEMS, get_system
from kkl_gym.system import System
from observers import Artifact, shipped
from observers.names import resolve
from training.config import checked_changes, read_changes, setting_types
from training.evaluation.levels import Level, read_level
from training.presets import named_policy
from training.progress import ProgressBars
from training.records import Record, Signals, read_records
from training.trajectories.motions import Controller
from training.trajectories.parameters import EVERY, blind, with_bias

Pairs = tuple[tuple[str, Any], ...]  # the words NAME=VALUE after an option
Repeated = tuple[Pairs, ...]  # an option that may be given several times; merged() combines the pairs


def words(read: Callable[[str], Any], metavar: str, nargs: Any = "*") -> PrimitiveConstructorSpec[Any]:
    """Return an option that takes several words, or one if ``nargs`` is 1; ``read`` converts each word."""
    return PrimitiveConstructorSpec(
        nargs=nargs,
        metavar=metavar,
        instance_from_str=lambda texts: tuple(map(read, texts)) if nargs == "*" else read(texts[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda value: list(map(str, (value or ()) if nargs == "*" else [value])),
    )


def pair(read: Callable[[str], Any], kind: str, form: str, alone: str = "") -> Callable[[str], tuple[str, Any]]:
    """Return a function that reads NAME=VALUE; a value without a name gets the name ``alone``, if given."""

    def read_pair(text: str) -> tuple[str, Any]:
        name, equals, value = text.partition("=")
        if alone and not equals:
            name, value = alone, text
        elif not (equals and name.strip()):
            raise ValueError(f"{text!r} is no {kind}: write {form}")
        try:
            return name.strip(), read(value)
        except ValueError:
            raise ValueError(f"{text!r} is no {kind}: write {form}") from None

    return read_pair


def read_unknown(text: str) -> tuple[float, ...]:
    """Read the first guess of an unknown parameter: VALUE, or VALUE:LOW:HIGH with limits."""
    numbers = tuple(map(float, text.split(":")))
    if len(numbers) not in (1, 3):
        raise ValueError(text)
    return numbers


def read_json(text: str) -> Any:
    """Read JSON, or return any other text."""
    try:
        return json.loads(text)
    except ValueError:
        return text.strip()


def read_setting(text: str) -> tuple[str, Any]:
    """Read a setting, written as ``width=64``, ``optimiser=adam`` or ``eigenvalues=-1,-2,-3``."""
    name, value = pair(str, "setting", "NAME=VALUE, as in width=64")(text)
    name = name.replace("-", "_")
    listed = get_origin(setting_types().get(name)) is tuple or "," in value
    value = read_json(value)
    if listed and isinstance(value, str):
        value = [read_json(word) for word in value.split(",") if word.strip()]
    return name, [value] if listed and not isinstance(value, list) else value


def hint(default: str = "", **named: Any) -> Any:
    """Describe the default of an option in words; other arguments are those of :func:`tyro.conf.arg`."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {default})" if default else "", **named)


def merged(option: str, repeated: Iterable[Pairs]) -> dict[str, Any]:
    """Return the values of an option by name; raise ValueError if a name has two values."""
    names = [name for pairs in repeated for name, _ in pairs]
    if len({*names}) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"{option} names {', '.join(twice)} twice")
    return {name: value for pairs in repeated for name, value in pairs}


def names_in(text: str) -> tuple[str, ...]:
    """Return the names in a comma-separated text."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


_PARAMETER = words(pair(float, "parameter with its value", "NAME=VALUE, as in mu=3.3"), "NAME=VALUE")
_UNKNOWN = pair(read_unknown, "first guess of a parameter", "NAME=VALUE, or NAME=VALUE:LOW:HIGH, as in mu=1.5:0.5:6")
_HALF_WIDTH = pair(float, "uncertainty of a parameter", "NAME=SHARE, as in mu=0.1, or a number for all", EVERY)
read_argument = pair(read_json, "argument of an environment", "NAME=VALUE, as in g=9.5")
NO_FILE = hint("no file", metavar="FILE")
SYSTEM = "A shipped system (lorenz, Lorenz or KKLLorenz-v0), or your own: script.py, script.py:Class or module:Class."
SystemName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SYSTEM", help=SYSTEM)]
OneSystem = Annotated[tyro.conf.Positional[str | None], hint("all four that ship", metavar="[SYSTEM]", help=SYSTEM)]
OwnSystem = Annotated[
    str | None,
    hint(metavar="CLASS", help="The system of the observers, if it is your own, as script.py:Class or module:Class."),
]
OneObserver = Annotated[
    str | None,
    hint(
        "the system's shipped map", metavar="MAP", help="An observer for SYSTEM: a shipped map or a .safetensors file."
    ),
]
Observers = Annotated[tyro.conf.Positional[tuple[str, ...]], hint(metavar="[MAP [MAP ...]]")]
Parameters = Annotated[
    tuple[Annotated[Pairs, _PARAMETER], ...],
    tyro.conf.UseAppendAction,
    hint("none", help="Physical parameters that differ from the system's defaults, as in rho=30."),
]
Plant = Annotated[tuple[Annotated[Pairs, _PARAMETER], ...], tyro.conf.UseAppendAction, hint("the observer's own")]
Unknowns = Annotated[
    tuple[Annotated[Pairs, words(_UNKNOWN, "NAME=VALUE[:LOW:HIGH]")], ...], tyro.conf.UseAppendAction, hint()
]
HalfWidths = Annotated[
    tuple[Annotated[Pairs, words(_HALF_WIDTH, "NAME=SHARE")], ...], tyro.conf.UseAppendAction, hint("none")
]
EnvironmentArguments = Annotated[
    tuple[Annotated[Pairs, words(read_argument, "NAME=VALUE")], ...],
    tyro.conf.UseAppendAction,
    hint("none", help="Arguments of the environment. Values are JSON or text."),
]
# A level is one number for all outputs, or comma-separated numbers, one for each.
NoiseLevel = Annotated[Level | None, words(read_level, "LEVEL", 1), hint("the system's own")]
NoiseLevels = Annotated[
    tuple[Level, ...] | None, words(read_level, "LEVEL [LEVEL ...]"), hint("0 and the system's own")
]
Seconds = Annotated[float | None, hint("the system's own", metavar="SECONDS")]
OwnPolicy = Annotated[
    str | None,
    hint(
        metavar="FUNCTION",
        help="The policy under which the observers were trained, if it is your own, as script.py:function or "
        "module:function. The system's own controller needs no option.",
    ),
]


@dataclass(frozen=True)
class RunOptions:
    """The folder of a training, and how it runs."""

    out: Annotated[
        Path | None,
        hint(
            "runs/NAME; identify: runs/NAME-identified or -adapted; agents: runs/agents/NAME-INFORMATION-SEED",
            metavar="FOLDER",
        ),
    ] = None
    """Folder for all files."""
    resume: bool = False
    """Resume from the checkpoints in the folder, if there are any."""
    threads: int = 1
    """CPU threads. More threads hardly help with small networks."""


def set_threads(threads: int) -> None:
    """Set the number of torch's threads."""
    # Imported here, because the import of torch takes seconds.
    import torch

    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    torch.set_num_threads(threads)


@dataclass(frozen=True)
class DataOptions:
    """The recorded data of a command; annotate fields of this type with ``tyro.conf.OmitArgPrefixes``."""

    data: Annotated[tuple[Path, ...], hint(metavar="FILE [FILE ...]")] = ()
    """Records: .npz files with arrays t, y and, if recorded, u and x; .csv or .parquet files with named columns; or
    rollouts in a Minari data set, as minari:ID or its folder, with signals named as in `kkl-gym record`."""
    time: Annotated[str, hint("t or time", metavar="COLUMN")] = ""
    """Column of the time in seconds."""
    measured: Annotated[str, hint("y, or y1, y2, ...", metavar="COLUMNS")] = ""
    """Measured outputs, separated by commas."""
    inputs: Annotated[str, hint("u, or u1, u2, ...", metavar="COLUMNS")] = ""
    """Known inputs, each held until the next sample."""
    hidden: Annotated[str, hint("x, or x1, x2, ...", metavar="COLUMNS")] = ""
    """Recorded states. For an angle, name cos(COLUMN) and sin(COLUMN)."""

    def read(self, progress: ProgressBars, system: System | None = None) -> list[Record]:
        """Read the files; raise ValueError if a column is named twice."""
        signals = Signals(self.time, *map(names_in, (self.measured, self.inputs, self.hidden)))
        with progress.phase("reading the records"):
            return read_records(
                self.data, signals=signals, system=system, warn=lambda text: progress.say(f"warning: {text}")
            )


@dataclass(frozen=True)
class SettingsOptions:
    """Changes of the preset's settings; docs/reference/commands.md lists all settings and their defaults."""

    config: Annotated[Path | None, NO_FILE] = None
    """TOML or JSON file of settings."""
    set: Annotated[
        tuple[Annotated[Pairs, words(read_setting, "NAME=VALUE")], ...], tyro.conf.UseAppendAction, hint("none")
    ] = ()
    """Single settings, which override those of the file, as in --set width=64 eigenvalues=-1,-2,-3."""
    seed: Annotated[int | None, hint("0")] = None
    """Seed of all random numbers."""

    def read(self) -> dict[str, Any]:
        """Return the changed settings by name, after checks."""
        settings = read_changes(self.config) if self.config else {}
        settings |= checked_changes(merged("--set", self.set), "--set")
        return settings if self.seed is None else settings | {"seed": self.seed}


@dataclass(frozen=True)
class PlayOptions:
    """The arguments of an environment, and the number of episodes or steps to play."""

    episodes: Annotated[int | None, hint("no limit")] = None
    """Episodes to play."""
    steps: Annotated[int | None, hint("100,000 (diagnose: 10,000) without --episodes")] = None
    """Largest number of steps to play."""
    env_kwargs: EnvironmentArguments = ()

    @property
    def arguments(self) -> dict[str, Any]:
        """The environment's arguments by name."""
        return merged("--env-kwargs", self.env_kwargs)


def read_observers(names: Sequence[str], own_system: str | None) -> list[tuple[str, Artifact, System]]:
    """Read observers, and find their systems."""
    if not names:
        raise ValueError(f"name an observer; shipped: {', '.join(shipped()) or 'none'}")
    artifacts = [(name, Artifact.read(resolve(name))) for name in names]
    return [(name, artifact, system_of(artifact, own_system)) for name, artifact in artifacts]


@dataclass(frozen=True)
class Shown:
    """An environment for a demo; ``observer`` None stands for the system's shipped observer, if there is one."""

    label: str
    env_id: str
    options: Mapping[str, Any]
    system: System
    observer: str | None

    @property
    def observed(self) -> bool:
        """Whether an observer is given or ships."""
        return self.observer is not None or self.system.name in shipped()


def shown(system: str | None, observer: str | None) -> list[Shown]:
    """Return the environments to show: all that ship, or the named one."""
    if system is None:
        if observer is not None:
            raise ValueError(f"name the system of the observer {observer} as well")
        return [Shown(env_id, env_id, {}, get_system(name), None) for name, env_id in ENV_IDS.items()]
    options: dict[str, Any] = {}
    if observer is None:
        one = get_system(system)
    else:
        artifact = Artifact.read(resolve(observer))
        one, options = system_of(artifact, system), {"dt": artifact.filter.dt}
    label = ENV_IDS[one.name] if type(one) in SYSTEMS.values() else one.name
    return [Shown(label, OWN_ID, {"system": one, **options}, one, observer)]


def read_policy(artifact: Artifact, system: System, own_policy: str | None) -> Controller | None:
    """Return the policy under which an observer is evaluated: the given one or, by default, that of its training."""
    trained = artifact.training.get("policy")
    if own_policy is None and trained is not None and trained != "controller":
        raise ValueError(
            f"this observer was trained under the policy {trained!r}, and must be evaluated under it, too: name it by "
            "--policy script.py:function"
        )
    name = own_policy or trained
    if name is None:
        return None
    if not artifact.nu:
        raise ValueError(f"the policy {name!r} needs an observer with inputs; this one has no inputs")
    policy = named_policy(system, name, artifact.filter.dt)
    return blind(policy, system.nx) if np.any(artifact.training.get("bias", 0.0)) else policy


def system_of(artifact: Artifact, given: str | None) -> System:
    """Return the system of an artifact, after a check that both match."""
    artifact.require_system()
    if given is None and artifact.system not in SYSTEMS:
        raise ValueError(f"{artifact.system!r} is not a shipped system: name its class with --system script.py:Class")
    base = get_system(given or artifact.system)
    if base.name == artifact.system and set(artifact.parameters) == set(base.parameters):
        base = base.replace(artifact.parameters)
    artifact.check(base.name, base.parameters, dt=artifact.filter.dt, ny=base.ny, nu=base.nu)
    return base


def model_of(artifact: Artifact, system: System) -> System:
    """Return a system with the biases that an artifact estimates, if any, as additional states."""
    bias = artifact.training.get("bias", 0.0)
    return with_bias(system, bias) if np.any(bias) else system
