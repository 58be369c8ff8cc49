"""Contents of the repository's Markdown pages: blocks of code, command lines, links.

A comment above a block of Python changes how the tests run the block; CONTRIBUTING.md lists these comments.
"""

import re
import shlex
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "examples/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
BLOCK = re.compile(r"((?:^<!--(?:(?!-->).)*-->\n+)*)^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"<!--\s*(slow|small|first|printed)\b:?\s*(.*?)\s*-->", re.DOTALL)


def name(page):
    """The path of a page relative to the repository."""
    return page.relative_to(ROOT).as_posix()


@dataclass(frozen=True)
class Block:
    page: Path
    comments: dict[str, str]
    language: str
    text: str

    @property
    def small(self):
        """The code with the smaller sizes that its comment gives."""
        text = self.text
        for change in filter(None, self.comments.get("small", "").split("; ")):
            large, _, little = change.partition(" -> ")
            assert large in text, f"{name(self.page)} has no {large!r} to make small in\n{text}"
            text = text.replace(large, little)
        return text

    @property
    def needs_training(self):
        """Whether only the slow tests run it."""
        return "slow" in self.comments


@dataclass(frozen=True)
class Page:
    path: Path

    @cached_property
    def text(self):
        return self.path.read_text(encoding="utf-8")

    @property
    def elsewhere(self):
        """The test that runs the page's blocks, if that is not test_pages.py."""
        found = re.match(r"<!-- run by (\S+) -->", self.text)
        return found and found[1]

    @cached_property
    def blocks(self):
        found = [
            Block(self.path, dict(COMMENT.findall(comments)), language, text)
            for comments, language, text in BLOCK.findall(self.text)
        ]
        assert len(found) == len(re.findall(r"^```", self.text, re.MULTILINE)) / 2, f"a fence of {self.path} is open"
        return found

    @property
    def prose(self):
        """The text without its blocks."""
        return re.sub(r"^```.*?^```", "", self.text, flags=re.MULTILINE | re.DOTALL)

    @property
    def anchors(self):
        """Anchors of the titles, named as GitHub and the site name them."""
        titles = re.findall(r"^#+ (.*)$", self.prose, re.MULTILINE)
        return {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}

    @property
    def commands(self):
        """Yield the words of each command in the shell blocks, without comments."""
        for block in self.blocks:
            if block.language == "sh":
                for line in block.text.replace("\\\n", " ").splitlines():
                    lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;")
                    lexer.whitespace_split = True
                    for joined, words in groupby(lexer, lambda word: set(word) <= set("|&;")):
                        if not joined:
                            yield list(words)
