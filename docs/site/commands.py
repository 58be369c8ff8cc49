"""Writes docs/reference/commands.md: every command of ``kkl-gym`` with its options, from the commands' parsers."""

import argparse
import inspect
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import tyro

from kkl_gym.system import System
from kkl_gym.systems import SYSTEMS
from training.cli import COMMANDS, Commands, load
from training.config import Config, Pipeline, setting_types
from training.files import table
from training.presets import Preset, preset
from training.sources.recorded import RECORDED

PAGE = Path(__file__).resolve().parents[1] / "reference" / "commands.md"
BEGINNING = """\
# Commands

`kkl-gym COMMAND --help` prints the same text. Arguments without dashes are positional.

The package does not include the commands that compare observers and agents. In a clone,
`python -m examples.research --help` lists them.

<!-- Written by `make docs` from the parsers of the commands. -->
"""
SETTINGS = """\
## Settings

`kkl-gym train` and `kkl-gym identify` take single settings by `--set NAME=VALUE`, and files of settings in TOML or
JSON by `--config FILE`:

```toml
width = 64
eigenvalues = [-1.0, -2.0, -4.0]
trajectories = 2000
```

Some defaults depend on `--preset`, `--pipeline` or `--data`: "fast 20, paper 512" is 20 for `--preset fast` and 512 for
`--preset paper`. Parentheses list the systems with their own value.
"""
OF_OPTIONS = ("pipeline", "policy")  # settings that have options, so that --set does not take them
DEFAULT = re.compile(r"\s*\((?:default: (.*)|(required|optional|sets: .*))\)\s*$", re.DOTALL)
SHOWN = 3  # longest tuple whose numbers the table lists


def page() -> str:
    """The whole page, in Markdown."""
    return "\n".join([BEGINNING, *sections("kkl-gym", COMMANDS), SETTINGS, *settings(), ""])


def sections(prog: str, commands: Commands) -> Iterator[str]:
    """A section for each of ``commands``, and for each of their subcommands."""
    for name, parser, description in parsers(prog, commands):
        rows = [row(action) for action in options(parser)]
        lines = table(["option and value", "meaning", "default"], rows) if rows else []
        level = "##" if len(name.removeprefix(prog).split()) == 1 else "###"
        yield "\n".join([f"{level} `{name}`", "", text(description, "\n\n"), "", *lines, ""])


def parsers(prog: str, commands: Commands) -> Iterator[tuple[str, argparse.ArgumentParser, str]]:
    """The full name (such as ``kkl-gym train``), parser and description of each command and subcommand."""
    for name, behind in commands.items():
        command = load(*behind)
        with warnings.catch_warnings():  # tyro deprecates its only function that lists the options
            warnings.simplefilter("ignore", DeprecationWarning)
            parser = tyro.extras.get_parser(command, config=(tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff))
        # numpydoc's sections are left out; they are for readers of the code
        yield f"{prog} {name}", parser, re.split(r"\n\n(?=\w+\n---)", inspect.getdoc(command) or "")[0]
        for action in parser._actions:
            if isinstance(action.choices, dict):
                for word, below in action.choices.items():
                    yield f"{prog} {name} {word}", below, below.description or ""


def options(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """The options and arguments of a parser, without --help and subcommands."""
    return [one for one in parser._actions if not isinstance(one.choices, dict) and one.dest != "help"]


def row(action: argparse.Action) -> list[str]:
    """The row of an option: names and value, meaning, default."""
    written = (action.help or "").replace("%%", "%")
    found = DEFAULT.search(written)
    default = (found[1] or (found[2] if found[2] == "required" else "") or "") if found else ""
    if action.nargs == 0:
        default = {"True": "yes", "False": "no"}.get(default, default)
    names = sorted(action.option_strings, key=lambda name: (name.startswith("--no-"), -len(name)))
    named = [", ".join(f"`{name}`" for name in names)] if names else []
    if action.metavar and action.nargs != 0:
        named.append(text(re.sub(r"(?<=\w),(?=\w)", ", ", str(action.metavar))))
    meaning = written[: found.start()] if found else written
    return ["<br>".join(named), text(meaning), text(default)]


def text(written: str, between: str = " ") -> str:
    """Text for Markdown: one line for each paragraph, with characters of tables and HTML escaped."""
    paragraphs = [" ".join(part.split()) for part in written.split("\n\n")]
    joined = between.join(paragraphs).replace("|", r"\|").replace("<", "&lt;").replace("*", r"\*").strip()
    return re.sub(r"\bdocs/(\S+\.md)", r"[\1](../\1)", joined)


@dataclass(frozen=True)
class Other(System):
    """An oscillator (1e5 rad/s, size 1e-5) unlike all shipped systems: a default in common with them is general."""

    name = "other"
    X = ((-1e-5, 1e-5), (-1e-5, 1e-5))
    bounds = ((-1e-4, 1e-4), (-1e-4, 1e-4))

    def f(self, x: Any) -> Any:
        """x1' = 1e5 x2, x2' = -1e5 x1."""
        return 1e5 * x[1], -1e5 * x[0]

    def h(self, x: Any) -> Any:
        """The first state."""
        return (x[0],)


def settings() -> list[str]:
    """The table of settings."""
    described = Config.__pydantic_fields__  # type: ignore[attr-defined]
    rows = [
        [f"`{name}`", text(described[name].description or ""), text(default)]
        for name, default in defaults().items()
        if name not in OF_OPTIONS
    ]
    return table(["setting", "meaning", "default"], rows)


def defaults() -> dict[str, str]:
    """Default of each setting as a text, for each preset and pipeline, and for records."""
    given = {"eigenvalues": (-1.0,)}  # given, because the search for eigenvalues takes time
    configs: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for pipeline in get_args(Pipeline):
        for name in get_args(Preset):
            systems: Mapping[str, System] = {"": Other(), **{key: cls() for key, cls in SYSTEMS.items()}}
            configs[pipeline, name] = {
                key: vars(preset(system, pipeline, name, changes=given)) for key, system in systems.items()
            }
    texts = {}
    for setting in setting_types():
        of = {case: _of_systems({key: config[setting] for key, config in at.items()}) for case, at in configs.items()}
        parts = [_of_presets(*(of[pipeline, name] for name in get_args(Preset))) for pipeline in get_args(Pipeline)]
        texts[setting] = parts[0] if parts[0] == parts[1] else f"{parts[0]}; spinn: {parts[1]}"
        if setting in RECORDED and (recorded := _value(RECORDED[setting])) != parts[0]:
            texts[setting] += f"; records: {recorded}"
    of_both = ("eigenvalues", "dt", "measurement_noise_max")
    return texts | dict.fromkeys(of_both, "from the system, or from the records")


def _of_systems(values: Mapping[str, Any]) -> str:
    usual = values[""]
    if usual not in [value for key, value in values.items() if key]:
        return "from the system"
    others = [f"{key} {_value(value)}" for key, value in values.items() if value != usual]
    return f"{_value(usual)} ({', '.join(others)})" if others else _value(usual)


def _of_presets(fast: str, paper: str) -> str:
    return fast if fast == paper else f"fast {fast}, paper {paper}"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value in ((), {}):
        return "none"
    if isinstance(value, tuple):
        return f"{len(value)} of them" if len(value) > SHOWN else " ".join(map(_value, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
