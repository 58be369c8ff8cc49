"""The figures of the pages: both themes are there, and what draws them takes its colours from the style."""

import re
import runpy
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image

import training.figures as figures
from examples.research.environments.tables import draw_curves
from training.agents import picture
from training.commands import coverage, faults, portraits

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
DRAW = runpy.run_path(str(DOCS / "figures" / "draw.py"))
PAGES = [*DOCS.rglob("*.md"), ROOT / "README.md"]
LIGHT_ALONE = {"figures/qube.png"}  # examples/research/figures.py says why


def pictures(pattern):
    """Pictures that pages name, by their places under docs/."""
    found = set()
    for page in PAGES:
        for name in re.findall(pattern, page.read_text(encoding="utf-8")):
            if not re.match("[a-z]+:", name):
                found.add((page.parent / name).resolve().relative_to(DOCS).as_posix())
    return found


def test_pages_show_pictures_that_are_there_in_both_themes():
    shown = pictures(r"!\[[^\]]*\]\(([^)\s]+)\)")
    assert len(shown) > 15
    names = {*shown, *(DRAW["in_theme"](name, "dark") for name in shown - LIGHT_ALONE)}
    assert not {name for name in names if not (DOCS / name).exists()}


def test_every_picture_is_of_use():
    """Pages show or link it, and what draws it is known."""
    there = {path.relative_to(DOCS).as_posix() for ending in ("png", "gif") for path in DOCS.rglob(f"*.{ending}")}
    drawn = {DRAW["in_theme"](name, theme) for name in DRAW["FIGURES"] for theme in ("light", "dark")}
    assert there == drawn | LIGHT_ALONE
    assert pictures(r"\]\(([^)\s]+\.(?:png|gif))\)") == set(DRAW["FIGURES"]) | LIGHT_ALONE


def test_the_readme_follows_the_readers_theme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (dark,) = re.findall(r'<source media="\(prefers-color-scheme: dark\)" srcset="docs/([^"]+)">', readme)
    (light,) = re.findall(r'<img alt="[^"]+" src="docs/([^"]+)">', readme)
    assert dark == DRAW["in_theme"](light, "dark")
    assert light in DRAW["FIGURES"]


def results(name, rows=slice(None)):
    return pd.read_csv(DOCS / "results" / name).iloc[rows]


TINY = {
    "estimates": lambda: DRAW["estimates"](0.3),
    "agents": DRAW["agents_over_time"],
    "errors over time": lambda: DRAW["errors_over_time"](trajectories=3, duration=0.5),
    "tracking": lambda: DRAW["tracking"](trajectories=3, duration=0.5),
    "error bars": lambda: DRAW["error_bars"](duration=1.5),
    "noise levels": DRAW["noise_levels"],
    "faults": lambda: partial(faults.draw, found=results("faults/faults.csv", slice(None, None, 50))),
    "coverage": lambda: partial(coverage.draw, rows=results("error_bars/van_der_pol-static.csv")),
    "curves": lambda: partial(draw_curves, found=results("environments/curves.csv", slice(None, None, 10))),
    "scores": DRAW["FIGURES"]["results/agents/scores.png"],
}


def outer(ax):
    """Whether axes are at the left or the lower edge of their grid, where its labels stand."""
    place = ax.get_subplotspec()
    return place.is_first_col() or place.is_last_row()


@pytest.mark.parametrize("name", TINY)
def test_figures_take_their_colours_from_the_style(name, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "save", lambda path, figure: drawn.append(figure))
    draw = TINY[name]()
    for theme in ("light", "dark"):
        with figures.style(theme):
            draw(tmp_path / "figure.png")
            figure = drawn.pop()
            own = {*figures.CYCLES[theme], figures.GROUNDS[theme], figures.RULES[theme]}
            artists = figure.findobj(lambda artist: isinstance(artist, (Line2D, Text)))
            assert len(artists) > 20
            assert {to_hex(artist.get_color()) for artist in artists} <= own
            assert to_hex(figure.get_facecolor()) == figures.GROUNDS[theme]
            assert all(ax.get_xlabel() or ax.get_ylabel() for ax in figure.axes if ax.get_visible() and outer(ax))


def test_two_agents_move_side_by_side(tmp_path, monkeypatch):
    """The one that sees y has no estimate to show; both start in the same state and end elsewhere."""
    monkeypatch.setattr(picture, "FRAMES", 4)
    task, played = DRAW["agents"]()
    blind, sighted = played.values()
    assert blind.x_hat is None
    assert sighted.x_hat.shape == sighted.x.shape == (task.steps + 1, 1, 2)
    assert (blind.x[0] == sighted.x[0]).all()
    late = task.steps // 2
    assert abs(blind.x[late:]).max() > 2 > 1.5 > abs(sighted.x[late:, 0, 0]).max()
    picture.animate(task, played, tmp_path / "agents.gif")
    with Image.open(tmp_path / "agents.gif") as gif:
        assert (gif.n_frames, gif.size) == (4, (960, 480))


def test_pictures_are_written_in_both_themes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(portraits, "FRAMES", 3)
    still, moving = "results/error_bars/van_der_pol.png", "figures/lorenz.gif"
    DRAW["FIGURES"].update({moving: partial(DRAW["portraits"], "lorenz", 0.3)})
    DRAW["main"]([still, moving], tmp_path)
    assert capsys.readouterr().out.count("wrote ") == 4
    for theme in ("light", "dark"):
        for name in (still, moving):
            with Image.open(tmp_path / DRAW["in_theme"](name, theme)) as picture:
                assert to_hex([c / 255 for c in picture.convert("RGB").getpixel((0, 0))]) == figures.GROUNDS[theme]
                assert picture.mode == "P"
    sketch = (tmp_path / "figures" / "kkl-dark.svg").read_text(encoding="utf-8")
    assert sketch == (DOCS / "figures" / "kkl-dark.svg").read_text(encoding="utf-8"), "make figures writes it"
    light = (DOCS / "figures" / "kkl.svg").read_text(encoding="utf-8")
    assert re.sub("#[0-9a-f]+", "", sketch) == re.sub("#[0-9a-f]+", "", light)
    assert not set(re.findall('"(#[0-9a-f]+)"', light)) & set(re.findall('"(#[0-9a-f]+)"', sketch))
