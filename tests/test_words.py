"""Sources, tests, messages and pages use the field's terms; these tests ban the phrases of an earlier dialect."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("observers", "kkl_gym", "training", "examples", "docs", "tests")
SUFFIXES = {".py", ".md", ".js", ".html", ".c", ".h", ".ipynb", ".css"}
EXCEPTED = {ROOT / "docs/reference/commands.md", Path(__file__)}
BANNED = re.compile(
    r"\b(?:[Tt]old|(?:is|are) none|[Nn]obody|[Ss]ays|[Aa]new|[Nn]o number|[Ww]hat (?:is|are|was|were))\b"
)
FILES = [
    path
    for path in [*ROOT.glob("*.md"), *(path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")))]
    if path.suffix in SUFFIXES and path not in EXCEPTED
]


def dialect(text: str) -> list[str]:
    """Lines with a banned phrase; lines that end with a question mark are exempt."""
    return [line.strip() for line in text.splitlines() if BANNED.search(line) and not line.rstrip(' "').endswith("?")]


def test_dialect_is_found():
    assert dialect("The level is none.\nWhat is x?\nThe caller passes x.") == ["The level is none."]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_have_no_banned_phrases(path):
    assert dialect(path.read_text(encoding="utf-8")) == []
