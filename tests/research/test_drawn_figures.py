"""The figures of the pages: both themes are there, and their colours are those of the style."""

import re
from functools import partial
from pathlib import Path

import pytest
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image

from examples.research import figures
from examples.research.figures import FIGURES, in_theme
from training import figures as styles

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [*DOCS.rglob("*.md"), ROOT / "README.md"]
LIGHT_ALONE = {"figures/qube.png"}  # examples/research/figures.py says why


def pictures(pattern):
    """Pictures that pages name, by their places under docs/."""
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


def test_every_picture_is_shown_and_drawn():
    there = {path.relative_to(DOCS).as_posix() for ending in ("png", "gif") for path in DOCS.rglob(f"*.{ending}")}
    assert there == {in_theme(name, theme) for name in FIGURES for theme in ("light", "dark")} | LIGHT_ALONE
    assert pictures(r"\]\(([^)\s]+\.(?:png|gif))\)") == set(FIGURES) | LIGHT_ALONE


@pytest.mark.parametrize(
    "make",
    [
        partial(figures.error_bars, duration=1.5),
        pytest.param(partial(figures.errors_over_time, trajectories=3, duration=0.5), marks=pytest.mark.research),
        pytest.param(figures.noise_levels, marks=pytest.mark.research),
    ],
)
def test_figures_take_their_colours_from_the_style(make, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(styles, "save", lambda path, figure: drawn.append(figure))
    draw = make()
    for theme in ("light", "dark"):
        with styles.style(theme):
            draw(tmp_path / "figure.png")
            figure = drawn.pop()
            own = {*styles.CYCLES[theme], styles.GROUNDS[theme], styles.RULES[theme]}
            artists = figure.findobj(lambda artist: isinstance(artist, (Line2D, Text)))
            assert len(artists) > 20
            assert {to_hex(artist.get_color()) for artist in artists} <= own
            assert to_hex(figure.get_facecolor()) == styles.GROUNDS[theme]


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
