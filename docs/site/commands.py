"""Writes docs/reference/commands.md: every command of ``kkl-gym`` with its options, from the parsers themselves."""

import argparse
import inspect
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import tyro

from training.cli import COMMANDS, Commands, load
from training.markdown import table

PAGE = Path(__file__).resolve().parents[1] / "reference" / "commands.md"
BEGINNING = """\
# Commands

`kkl-gym COMMAND --help` prints the same. Where `--preset`, `--pipeline` or `--data` makes a difference, a default names
each: "fast 20, paper 512" is 20 for `--preset fast` and 512 for `--preset paper`. In parentheses follow the systems
that have a value of their own. What has no dashes is written in its place.

Commands that compare observers and agents are no part of the package. In a clone, `python -m examples.research --help`
lists them.

<!-- Written by `make docs` from the parsers of the commands. -->
"""
DEFAULT = re.compile(r"\s*\((?:default: (.*)|(required|optional|sets: .*))\)\s*$", re.DOTALL)


def page() -> str:
    """The whole page, in Markdown."""
    return "\n".join([BEGINNING, *sections("kkl-gym", COMMANDS)])


def sections(prog: str, commands: Commands) -> Iterator[str]:
    """A section for each command of a table, and for each of those below it."""
    for name, behind in commands.items():
        command = load(*behind)
        with warnings.catch_warnings():  # nothing else in tyro says what the options are
            warnings.simplefilter("ignore", DeprecationWarning)
            parser = tyro.extras.get_parser(command, config=(tyro.conf.DisallowNone,))
        yield from _sections(f"{prog} {name}", "##", parser, inspect.getdoc(command) or "")


def _sections(name: str, level: str, parser: argparse.ArgumentParser, said: str) -> Iterator[str]:
    below, rows = [], []
    for action in parser._actions:
        if isinstance(action.choices, dict):
            below = list(action.choices.items())
        elif action.dest != "help":
            rows.append(_row(action))
    if "\n\n" in said:  # numpydoc's sections are for those who read the code
        said = re.split(r"\n\n(?=\w+\n---)", said)[0]
    lines = table(["option and value", "meaning", "default"], rows) if rows else []
    yield "\n".join([f"{level} `{name}`", "", _text(said, "\n\n"), "", *lines, ""])
    for word, inner in below:
        yield from _sections(f"{name} {word}", f"{level}#", inner, inner.description or "")


def _row(action: argparse.Action) -> list[str]:
    """Names and value, what it is, and the default."""
    said = (action.help or "").replace("%%", "%")
    found = DEFAULT.search(said)
    default = (found[1] or (found[2] if found[2] == "required" else "") or "") if found else ""
    if action.nargs == 0:
        default = {"True": "yes", "False": "no"}.get(default, default)
    names = sorted(action.option_strings, key=lambda name: (name.startswith("--no-"), -len(name)))
    named = [", ".join(f"`{name}`" for name in names)] if names else []
    if action.metavar and action.nargs != 0:
        named.append(_text(re.sub(r"(?<=\w),(?=\w)", ", ", str(action.metavar))))
    meaning = said[: found.start()] if found else said
    return ["<br>".join(named), _text(meaning), _text(default)]


def _text(said: str, between: str = " ") -> str:
    """For Markdown: paragraphs in a line each, and nothing in them taken for a table or HTML."""
    paragraphs = [" ".join(part.split()) for part in said.split("\n\n")]
    text = between.join(paragraphs).replace("|", r"\|").replace("<", "&lt;").replace("*", r"\*").strip()
    return re.sub(r"\bdocs/(\S+\.md)", r"[\1](../\1)", text)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
