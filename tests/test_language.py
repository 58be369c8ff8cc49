"""Prose on the pages: no sentence is longer than 35 words."""

import re

from pages import PAGES, name

LONGEST = 35
ELSEWHERE = {"CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "examples/README.md"}
PROSE = [page for page in PAGES if page.name != "table.md" and name(page) not in ELSEWHERE]  # commands write tables

# A full stop after one of these ends no sentence where something follows.
ABBREVIATIONS = re.compile(r"\b(?:e\.g|i\.e|et al|al|cf|vs|sec|Sec|eq|Eq|fig|Fig|ch|no|[C-SU-WYZ])\.$")
ENDS = re.compile(r"(?<=[.!?])[)\"'*_”]*\s+")


def blocks(page):
    """Paragraphs, list items and headings of a page, without code, tables, pictures and the addresses of links."""
    page = re.sub(r"\A---\n.*?\n---\n", "", page, flags=re.DOTALL)
    page = re.sub(r"^( *)(```|~~~).*?^\1\2 *$", "", page, flags=re.DOTALL | re.MULTILINE)
    page = re.sub(r"<!--.*?-->|\$\$.*?\$\$|\\\[.*?\\\]", "", page, flags=re.DOTALL)
    page = re.sub(r"`[^`]+`", "code", page)
    page = re.sub(r"!\[[^\]]*\]\([^)]*\)(?:\{[^}]*\})?", "", page)
    page = re.sub(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\([^)]*\)", r"\1", page)
    page = re.sub(r"<[^>\n]+>", "", page)
    page = re.sub(r"^ *(?:\||#).*$|^ *[-=]{3,} *$", "", page, flags=re.MULTILINE)
    page = re.sub(r"^ *(?:[-*+]|\d+\.|!!!|\?\?\?) +", "\n\n", page, flags=re.MULTILINE)
    return [" ".join(block.split()) for block in re.split(r"\n\s*\n", page) if block.strip()]


def sentences(page):
    """The sentences of a page's prose."""
    for block in blocks(page):
        begun = ""
        for part in ENDS.split(block):
            begun = f"{begun} {part}".strip()
            if not ABBREVIATIONS.search(begun):
                yield begun
                begun = ""
        if begun:
            yield begun


def words(sentence):
    """The words of a sentence: signs between them are none, and neither are dashes."""
    return [word for word in sentence.split() if any(character.isalnum() for character in word)]


def test_no_sentence_is_too_long():
    for page in PROSE:
        found = list(sentences(page.read_text(encoding="utf-8")))
        assert found
        too_long = [f"{len(words(one))} words: {one}" for one in found if len(words(one)) > LONGEST]
        assert not too_long, "\n".join([name(page), *too_long])


def test_sentences_are_found():
    """As the eye finds them: code, tables, pictures and addresses are no prose, abbreviations end nothing."""
    page = (
        "# A title of no account\n\nOne [link](https://example.org/a.b) here. Two, by Wu et al. 2023, e.g. `x. y`!\n"
        "\n| a | table |\n\n```sh\nsome code. more\n```\n\n- An *item.* And\n  its end\n- another: x = 0.5 y\n"
    )
    assert list(sentences(page)) == [
        "One link here.", "Two, by Wu et al. 2023, e.g. code!", "An *item.", "And its end", "another: x = 0.5 y",
    ]  # fmt: skip
    assert words("another: x = 0.5 y – z") == ["another:", "x", "0.5", "y", "z"]
    assert [len(words(one)) for one in sentences("word " * 36 + "end.")] == [37]
