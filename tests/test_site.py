"""The site: its reference is whole and new, and its links hold where GitHub's do."""

import json
import re
import runpy
import subprocess
import sys
from base64 import b64encode
from pathlib import Path

import pytest

import kkl_gym
import observers
import training

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
REPOSITORY = "https://host/repository"


def test_the_page_of_commands_is_new():
    page = runpy.run_path(str(DOCS / "site" / "commands.py"))["page"]()
    assert page == (DOCS / "reference" / "commands.md").read_text(), "make docs writes the page"
    for option in ("--preset", "--measurement-noise", "`--ekf`, `--no-ekf`"):
        assert option in page
    assert "| fast 128, paper 512 |\n" in page
    assert "### `python -m examples.research agents`" in page


@pytest.mark.parametrize("package", [kkl_gym, observers, training])
def test_the_reference_has_every_public_name(package):
    page = (DOCS / "reference" / f"{package.__name__}.md").read_text()
    described = re.findall(rf"^::: {package.__name__}\.(\w+)$", page, re.MULTILINE)
    assert len(described) == len(set(described))
    assert set(described) >= set(package.__all__)


@pytest.mark.parametrize(
    ("source", "page", "link", "becomes"),
    [
        ("docs/guides/check.md", "guides/check.md", "data.md#records", "data.md#records"),
        ("docs/guides/check.md", "guides/check.md", "../results/accuracy.csv", "../results/accuracy.csv"),
        ("docs/guides/check.md", "guides/check.md", "../../Makefile", f"{REPOSITORY}/blob/main/Makefile"),
        ("docs/guides/check.md", "guides/check.md", "../../training", f"{REPOSITORY}/tree/main/training"),
        ("docs/guides/check.md", "guides/check.md", "../results/agents", f"{REPOSITORY}/tree/main/docs/results/agents"),
        ("docs/guides/check.md", "guides/check.md", "../../CONTRIBUTING.md", "../development/contributing.md"),
        ("docs/start/a.md", "start/a.md", "../../examples/notebooks/own_system.ipynb", "../notebooks/own_system.md"),
        ("CONTRIBUTING.md", "development/contributing.md", "docs/guides/check.md#a", "../guides/check.md#a"),
        ("CHANGELOG.md", "development/changes.md", "README.md", f"{REPOSITORY}/blob/main/README.md"),
        ("docs/guides/check.md", "guides/check.md", "https://arxiv.org", "https://arxiv.org"),
        ("docs/guides/check.md", "guides/check.md", "#here", "#here"),
    ],
)  # fmt: skip
def test_links_lead_to_the_same_place_in_the_site(source, page, link, becomes):
    relinked = runpy.run_path(str(DOCS / "site" / "hooks.py"))["relinked"]
    text = "See [`it`]({}), `[x]({})`.\n\n```python\nx[0]({})\n```\n"
    assert relinked(text.format(link, link, link), source, page, repository=REPOSITORY) == text.format(
        becomes, link, link
    )


def test_pictures_are_light_and_dark_where_both_are_there(tmp_path):
    themed = runpy.run_path(str(DOCS / "site" / "hooks.py"))["themed"]
    (tmp_path / "figures").mkdir()
    for name in ("a.png", "a-dark.png", "b.png"):
        (tmp_path / "figures" / name).touch()
    (tmp_path / "guides").mkdir()
    a, b, code = "![An a](../figures/a.png)", "![A b](../figures/b.png)", "`![An a](../figures/a.png)`"
    twice = (
        "![An a](../figures/a.png#only-light){ loading=lazy }![An a](../figures/a-dark.png#only-dark){ loading=lazy }"
    )
    text = "One {}\n\n{}\n\n{}, [a link](../figures/a.png)\n\n```md\n![An a](../figures/a.png)\n```\n"
    assert themed(text.format(a, b, code), tmp_path / "guides") == text.format(twice, b, code)


def test_notebooks_are_pages():
    """Their words, code, and what that printed and drew; of all of them, executed or not."""
    hooks = runpy.run_path(str(DOCS / "site" / "hooks.py"))
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (800).to_bytes(4, "big") + (400).to_bytes(4, "big")
    drawn = {"output_type": "display_data", "data": {"image/png": b64encode(png).decode(), "text/plain": ["<Figure>"]}}
    printed = {"output_type": "stream", "name": "stdout", "text": ["4\n", "5\n"]}
    warned = {"output_type": "stream", "name": "stderr", "text": ["a warning\n"]}
    cells = [
        {"cell_type": "markdown", "source": ["# A title\n", "words"]},
        {"cell_type": "code", "source": ["a = 2\n", "print(2 * a)"], "outputs": [warned, printed, drawn]},
    ]
    text, pictures = hooks["talk"]({"cells": cells}, "mine")
    assert text == (
        "# A title\nwords\n\n```python\na = 2\nprint(2 * a)\n```\n\n```text\n4\n5\n```\n\n"
        '<img alt="What this code draws" class="wide" loading="lazy" src="mine-0.png">\n'
    )
    assert pictures == {"mine-0.png": png}
    site = (DOCS / "site" / "mkdocs.yml").read_text()
    assert len(hooks["NOTEBOOKS"]) == 5
    for path in hooks["NOTEBOOKS"]:
        assert hooks["talk"](json.loads(path.read_text()), path.stem)[0].startswith("# ")
        assert f": notebooks/{path.stem}.md\n" in site


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(DOCS / "site" / "mkdocs.yml")]
    done = subprocess.run([*command, "-d", str(tmp_path / "site")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for path in (tmp_path / "site").rglob("*.html"):
        outside = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="?(https?://[^" >]+)', path.read_text())
        assert not outside, f"{path} asks another host for {outside[0]}"
