"""The task of an agent as options of a command."""

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from training.agents.tasks import Task, get_task
from training.commands.record import EnvironmentArguments

Measured = Annotated[
    str, tyro.conf.arg(metavar="INDICES", help_behavior_hint="(default: the positions, of environments known here)")
]


@dataclass(frozen=True)
class TaskOptions:
    """Options of a task; to be annotated with ``tyro.conf.OmitArgPrefixes``."""

    measured: Measured = ""
    """Entries of the flattened observation that agents may see, with commas between them, as in 0,1. Of systems y is
    measured."""
    hidden: Annotated[str, tyro.conf.arg(metavar="INDICES", help_behavior_hint="(default: all others)")] = ""
    """Entries that an observer estimates."""
    env_kwargs: EnvironmentArguments = ()
    """An argument of the environment, once for each; values are JSON, or text."""
    time_constants: Annotated[str, tyro.conf.arg(metavar="STEPS", help_behavior_hint="(default: 1,2,4,8)")] = ""
    """Time constants of z's memory and of traces, in actions. Where there is no noise, 1 or 1,2 may be easier to learn
    with."""
    frames: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: 8)")] = None
    """Number of stacked observations, each with the action before it."""
    no_past_actions: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave past actions out of z, traces and stacked."""
    angles: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PAIR", help_behavior_hint="(default: none)")
    ] = ()
    """Measured entries that are the cosine and the sine of an angle, once for each angle, as in 0,1. Then z holds how
    far it has turned."""

    def task(self, name: str, measurement_noise: Any = None) -> Task:
        """The task of a system or an environment with these options."""
        changes: dict[str, Any] = {
            "measured": _numbers("measured", self.measured, int),
            "hidden": _numbers("hidden", self.hidden, int),
            "env_kwargs": dict(self.env_kwargs),
            "time_constants": _numbers("time-constants", self.time_constants, float),
            "frames": self.frames,
            "angles": tuple(map(_pair, self.angles)),
        }
        given = {key: value for key, value in changes.items() if value not in ((), {}, None)}
        if self.no_past_actions:
            given["past_actions"] = False
        return get_task(name, measurement_noise, **given)


def _numbers(name: str, text: str, kind: type) -> tuple[Any, ...]:
    try:
        return tuple(kind(entry) for entry in text.split(",") if entry.strip())
    except ValueError:
        what = "indices in the flattened observation, as in 0,1" if kind is int else "numbers of steps, as in 1,2"
        raise ValueError(f"--{name} takes {what}; got {text!r}") from None


def _pair(text: str) -> tuple[int, int]:
    entries = _numbers("angles", text, int)
    if len(entries) != 2:
        raise ValueError(
            f"--angles takes the cosine's entry and the sine's, once for each angle, as in 0,1; got {text!r}"
        )
    return entries[0], entries[1]
