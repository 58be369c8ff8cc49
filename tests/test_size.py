"""The budgets of the package's size; ``pytest tests/test_size.py -s`` prints the counts."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def lines(*folders):
    """Lines of each Python file in some folders."""
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    return {path: path.read_text(encoding="utf-8").count("\n") for path in paths}


@pytest.mark.parametrize(
    ("folders", "most", "files"),
    [
        (("observers", "kkl_gym", "training"), 26_000, 150),
        (("observers",), 4_500, None),
        (("kkl_gym",), 6_000, None),
        (("training",), 15_500, None),
        (("training/export",), 1_000, None),
        (("training/agents",), 2_000, None),
        (("tests",), 20_000, None),
        (("examples/research",), 4_500, None),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, tuple) else None,
)
def test_lines_and_modules(folders, most, files):
    counted = lines(*folders)
    print(f"{'+'.join(folders)}: {sum(counted.values())} lines in {len(counted)} files")
    assert sum(counted.values()) <= most
    assert files is None or len(counted) <= files
    assert max(counted.values()) <= 500


def test_commands_and_options():
    page = (ROOT / "docs/reference/commands.md").read_text(encoding="utf-8")
    commands = set(re.findall(r"^## `kkl-gym ([a-z-]+)", page, re.MULTILINE))
    options = set(re.findall(r"^\| `(--[a-z-]+)`", page, re.MULTILINE))
    print(f"{len(commands)} commands, {len(options)} options")
    assert 0 < len(commands) <= 12
    assert 0 < len(options) <= 70


def test_words_of_the_pages():
    generated = {"commands.md", "table.md"}
    pages = [path for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")] if path.name not in generated]
    words = sum(len(path.read_text(encoding="utf-8").split()) for path in pages)
    print(f"{words} words")
    assert words <= 35_000
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 90
