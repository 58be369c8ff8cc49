"""The figures of the pages exist in both themes, and have the colours of the style."""

import re
from pathlib import Path

import pytest
from matplotlib.colors import to_hex
from PIL import Image

from examples.research import figures
from examples.research.figures import FIGURES, in_theme
from training import figures as styles

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [*DOCS.rglob("*.md"), ROOT / "README.md"]
LIGHT_ALONE = {"figures/qube.png"}  # examples/research/figures.py gives the reason


def pictures(pattern):
    """Paths relative to docs/ of the pictures that pages link to by a pattern."""
    names = set()
    for page in PAGES:
        for name in re.findall(pattern, page.read_text(encoding="utf-8")):
            if not re.match("[a-z]+:", name):
                names.add((page.parent / name).resolve().relative_to(DOCS).as_posix())
    return names


def test_pages_show_pictures_that_are_there_in_both_themes():
    shown = pictures(r"!\[[^\]]*\]\(([^)\s]+)\)")
    assert len(shown) > 15
    assert not [name for name in shown if not (DOCS / name).exists()]
    assert not [name for name in shown - LIGHT_ALONE if not (DOCS / in_theme(name, "dark")).exists()]


def test_every_picture_is_on_a_page_and_in_figures():
    there = {path.relative_to(DOCS).as_posix() for ending in ("png", "gif") for path in DOCS.rglob(f"*.{ending}")}
    assert there == {in_theme(name, theme) for name in FIGURES for theme in ("light", "dark")} | LIGHT_ALONE
    assert pictures(r"\]\(([^)\s]+\.(?:png|gif))\)") == set(FIGURES) | LIGHT_ALONE


def test_a_picture_is_written_in_both_themes(tmp_path, capsys):
    name = "results/faults/scores.png"
    figures.main([name], tmp_path)
    assert capsys.readouterr().out.count("wrote ") == 2
    for theme in ("light", "dark"):
        with Image.open(tmp_path / in_theme(name, theme)) as picture:
            assert to_hex([c / 255 for c in picture.convert("RGB").getpixel((0, 0))]) == styles.GROUNDS[theme]
            assert picture.mode == "P"
    sketch = (tmp_path / "figures" / "kkl-dark.svg").read_text(encoding="utf-8")
    assert sketch == (DOCS / "figures" / "kkl-dark.svg").read_text(encoding="utf-8"), "make figures writes it"
    with pytest.raises(SystemExit, match=r"there is no figure mine\.png"):
        figures.main(["mine.png"], tmp_path)
