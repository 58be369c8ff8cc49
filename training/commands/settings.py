"""The settings of a configuration as options of ``kkl-gym train``, each with its defaults."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypedDict, get_args

import tyro

from kkl_gym.system import System
from kkl_gym.systems import SYSTEMS
from training.config import Config, Pipeline, setting_types
from training.presets import Preset, preset
from training.sources.recorded import RECORDED

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
    """Default of each setting as a text, for each preset and pipeline, and for records."""
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
        if setting in RECORDED and (text := _text(RECORDED[setting])) != parts[0]:
            texts[setting] += f"; records: {text}"
    of_both = ("eigenvalues", "dt", "measurement_noise_max")
    return texts | dict.fromkeys(of_both, "from the system, or from the records")


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


def _options() -> Any:
    """A dictionary of the settings that are given, with the descriptions of the configuration."""
    described = Config.__pydantic_fields__  # type: ignore[attr-defined]
    kinds, options = setting_types(), {}
    for setting, default in defaults().items():
        if setting not in ELSEWHERE:
            argument = tyro.conf.arg(
                help=" ".join((described[setting].description or "").split()),
                help_behavior_hint=f"(default: {default})",
            )
            options[setting] = Annotated[kinds[setting], argument]
    return TypedDict("Settings", options, total=False)  # type: ignore[operator]


if TYPE_CHECKING:
    Settings = dict[str, Any]
else:
    Settings = _options()

__all__ = ["Settings", "defaults"]
