"""Settings of a training, of which docs/reference/commands.md has a table: a file of them, and single ones."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_origin

import tyro

from training.commands.options import Pairs, merged, words
from training.config import checked_changes, read_changes, setting_types


def read_setting(text: str) -> tuple[str, Any]:
    """Read a setting, written as ``width=64``, ``optimiser=adam`` or ``eigenvalues=-1,-2,-3``."""
    name, equals, value = text.partition("=")
    name = name.strip().replace("-", "_")
    if not equals:
        raise ValueError(f"{text!r} is no setting: write NAME=VALUE, as in width=64")
    listed = get_origin(setting_types().get(name)) is tuple or "," in value
    try:
        read = json.loads(value)
    except ValueError:
        read = [_word(word) for word in value.split(",") if word.strip()] if listed else value
    return name, [read] if listed and not isinstance(read, list) else read


def _word(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text.strip()


@dataclass(frozen=True)
class SettingsOptions:
    """What is to differ from the preset; docs/reference/commands.md lists the settings and their defaults."""

    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """TOML or JSON file of settings."""
    set: Annotated[
        tuple[Annotated[Pairs, words(read_setting, "NAME=VALUE")], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(help_behavior_hint="(default: none)"),
    ] = ()
    """Single settings, which come before those of the file, as in --set width=64 eigenvalues=-1,-2,-3."""
    seed: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: 0)")] = None
    """Seed of everything random."""

    def read(self) -> dict[str, Any]:
        """The settings by name, checked."""
        settings = read_changes(self.config) if self.config else {}
        settings |= checked_changes(merged("--set", self.set), "--set")
        return settings if self.seed is None else settings | {"seed": self.seed}
