"""The settings of a configuration as options of ``kkl-gym train``, each with what the presets take for it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, TypedDict, get_args

import tyro

from kkl_gym.system import System
from kkl_gym.systems import SYSTEMS
from training.config import Config, Pipeline, setting_types
from training.presets import Preset, preset
from training.recorded.config import RecordedConfig

SHOWN = 3  # numbers of a setting that has many
ELSEWHERE = ("pipeline", "uncertain", "inputs")  # options of their own


@dataclass(frozen=True)
class Other(System):
    """An oscillator of 1e5 rad/s and a size of 1e-5, unlike those that ship: what it shares with them is anyone's."""

    name = "other"
    X = ((-1e-5, 1e-5), (-1e-5, 1e-5))
    bounds = ((-1e-4, 1e-4), (-1e-4, 1e-4))

    def f(self, x: Any) -> Any:
        """x1' = 1e5 x2, x2' = -1e5 x1."""
        return 1e5 * x[1], -1e5 * x[0]

    def h(self, x: Any) -> Any:
        """The first state."""
        return (x[0],)


def defaults() -> dict[str, str]:
    """What each setting is where nobody says it, for people."""
    given = {"eigenvalues": (-1.0,)}  # none are to be looked for, which takes time
    found: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for pipeline in get_args(Pipeline):
        for name in get_args(Preset):
            systems: Mapping[str, System] = {"": Other(), **{key: cls() for key, cls in SYSTEMS.items()}}
            found[pipeline, name] = {
                key: vars(preset(system, pipeline, name, changes=given)) for key, system in systems.items()
            }
    texts = {}
    for setting in setting_types():
        of = {case: _of_systems({key: config[setting] for key, config in at.items()}) for case, at in found.items()}
        parts = [_of_presets(*(of[pipeline, name] for name in get_args(Preset))) for pipeline in get_args(Pipeline)]
        texts[setting] = parts[0] if parts[0] == parts[1] else f"{parts[0]}; spinn: {parts[1]}"
    return texts | {"eigenvalues": "from the system"}


def _of_systems(values: Mapping[str, Any]) -> str:
    usual = values[""]
    if usual not in [value for key, value in values.items() if key]:
        return "from the system"
    others = [f"{key} {_text(value)}" for key, value in values.items() if value != usual]
    return f"{_text(usual)} ({', '.join(others)})" if others else _text(usual)


def _of_presets(fast: str, paper: str) -> str:
    return fast if fast == paper else f"fast {fast}, paper {paper}"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value in ((), {}):
        return "none"
    if isinstance(value, tuple):
        return f"{len(value)} of them" if len(value) > SHOWN else " ".join(map(_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _options(name: str, of: Any, defaults: Mapping[str, str]) -> Any:
    """A dictionary of settings, those that are given, with the descriptions of a class of settings."""
    described = of.__pydantic_fields__
    kinds = {entry.name: entry.type for entry in fields(of)}
    options = {}
    for setting, default in defaults.items():
        argument = tyro.conf.arg(
            help=" ".join((described[setting].description or "").split()), help_behavior_hint=f"(default: {default})"
        )
        options[setting] = Annotated[kinds[setting], argument]
    return TypedDict(name, options, total=False)  # type: ignore[operator]


def _of_records() -> dict[str, str]:
    """Defaults of the settings that only a training on recorded states has."""
    found = {entry.name: entry.default for entry in fields(RecordedConfig)}
    return {name: _text(default) for name, default in found.items() if name not in setting_types()}


if TYPE_CHECKING:
    Settings = dict[str, Any]
    RecordedSettings = dict[str, Any]
else:
    Settings = _options("Settings", Config, {k: v for k, v in defaults().items() if k not in ELSEWHERE})
    RecordedSettings = _options("RecordedSettings", RecordedConfig, _of_records())

__all__ = ["RecordedSettings", "Settings", "defaults"]
