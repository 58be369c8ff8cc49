"""The site, which `make docs` builds: the reference is complete and up to date, and links work as on GitHub."""

import ast
import re
import runpy
from base64 import b64encode
from pathlib import Path

import nbformat
import pytest

import kkl_gym
import observers
import training

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
REPOSITORY = "https://host/repository"
HOOKS = runpy.run_path(str(DOCS / "site" / "hooks.py"))


def test_the_page_of_commands_is_up_to_date():
    page = runpy.run_path(str(DOCS / "site" / "commands.py"))["page"]()
    assert page == (DOCS / "reference" / "commands.md").read_text(), "make docs writes the page"
    width = "fast 20, paper 512; spinn: fast 128, paper 512; records: 96 |\n"
    for shown in ("--preset", "`--ekf`", width, "### `kkl-gym agent train`"):
        assert shown in page


@pytest.mark.parametrize("package", [kkl_gym, observers, training])
def test_the_reference_has_every_public_name(package):
    page = (DOCS / "reference" / f"{package.__name__}.md").read_text()
    described = re.findall(rf"^::: {package.__name__}\.(\w+)$", page, re.MULTILINE)
    assert len(described) == len(set(described))
    assert set(described) >= set(package.__all__)


def test_links_lead_to_the_same_place_in_the_site():
    text = "See [`it`]({}), `[x]({})`.\n\n```python\nx[0]({})\n```\n"
    for source, page, link, becomes in [
        ("docs/guides/diagnose.md", "guides/diagnose.md", "data.md#records", "data.md#records"),
        ("docs/guides/diagnose.md", "guides/diagnose.md", "../../Makefile", f"{REPOSITORY}/blob/main/Makefile"),
        ("docs/guides/diagnose.md", "guides/diagnose.md", "../../training", f"{REPOSITORY}/tree/main/training"),
        ("docs/guides/diagnose.md", "guides/diagnose.md", "../../CONTRIBUTING.md", "../development/contributing.md"),
        ("docs/start/a.md", "start/a.md", "../../examples/notebooks/own_system.ipynb", "../notebooks/own_system.md"),
        ("CONTRIBUTING.md", "development/contributing.md", "docs/guides/diagnose.md#a", "../guides/diagnose.md#a"),
        ("docs/guides/diagnose.md", "guides/diagnose.md", "https://arxiv.org", "https://arxiv.org"),
    ]:
        relinked = HOOKS["relinked"](text.format(link, link, link), source, page, repository=REPOSITORY)
        assert relinked == text.format(becomes, link, link)


def test_pictures_are_light_and_dark_where_both_are_there(tmp_path):
    for folder in ("figures", "guides"):
        (tmp_path / folder).mkdir()
    for name in ("a.png", "a-dark.png", "b.png"):
        (tmp_path / "figures" / name).touch()
    a, b, code = "![An a](../figures/a.png)", "![A b](../figures/b.png)", "`![An a](../figures/a.png)`"
    twice = (
        "![An a](../figures/a.png#only-light){ loading=lazy }![An a](../figures/a-dark.png#only-dark){ loading=lazy }"
    )
    text = "One {}\n\n{}\n\n{}, [a link](../figures/a.png)\n\n```md\n![An a](../figures/a.png)\n```\n"
    assert HOOKS["themed"](text.format(a, b, code), tmp_path / "guides") == text.format(twice, b, code)


def test_formulas_are_mathml():
    page = '<span class="arithmatex">\\(a &lt; b\\)</span><div class="arithmatex">\\[\nx_1\n\\]</div>'
    typeset = HOOKS["typeset"](page)
    assert re.search(r'<span class="formula"><math [^>]+"inline"><mrow><mi>a</mi><mo>&#x0003C;</mo><mi>b</mi>', typeset)
    assert re.search(r'<div class="formula"><math [^>]+"block"><mrow><msub><mi>x</mi><mn>1</mn></msub>', typeset)


def test_notebooks_are_pages():
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (800).to_bytes(4, "big") + (400).to_bytes(4, "big")
    drawn = {"output_type": "display_data", "data": {"image/png": b64encode(png).decode(), "text/plain": ["<Figure>"]}}
    printed = {"output_type": "stream", "name": "stdout", "text": ["4\n", "5\n"]}
    warned = {"output_type": "stream", "name": "stderr", "text": ["a warning\n"]}
    cells = [
        {"cell_type": "markdown", "source": ["# A title\n", "words"]},
        {"cell_type": "code", "source": ["a = 2\n", "print(2 * a)"], "outputs": [warned, printed, drawn]},
    ]
    text, pictures = HOOKS["talk"]({"cells": cells}, "mine")
    assert text == (
        "# A title\nwords\n\n```python\na = 2\nprint(2 * a)\n```\n\n```text\n4\n5\n```\n\n"
        '<img alt="What this code draws" class="wide" loading="lazy" src="mine-0.png">\n'
    )
    assert pictures == {"mine-0.png": png}


@pytest.mark.parametrize("path", HOOKS["NOTEBOOKS"], ids=lambda path: path.stem)
def test_notebooks_are_valid_without_outputs_and_their_imports_work(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    for page in (DOCS / "start" / "notebooks.md", ROOT / "examples" / "README.md"):
        assert f"notebooks/{path.name}" in page.read_text(encoding="utf-8")
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert (cell.outputs, cell.execution_count) == ([], None)
            for node in ast.walk(ast.parse(cell.source)):
                if isinstance(node, ast.Import | ast.ImportFrom):
                    exec(ast.unparse(node), {})
