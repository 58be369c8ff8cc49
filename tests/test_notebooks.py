"""The notebooks: whole files without outputs, whose code compiles, finds what it imports, and runs."""

import ast
import importlib
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
PAGES = ("docs/start/notebooks.md", "examples/README.md")


def ids(path):
    return path.stem


def read(path):
    return nbformat.read(path, as_version=4)


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_all_are_there():
    assert len(NOTEBOOKS) == 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=ids)
def test_files_are_whole_and_hold_no_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    assert 8 <= len(notebook.cells) <= 14
    for cell in code(notebook):
        assert not cell.outputs
        assert cell.execution_count is None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=ids)
def test_code_compiles_and_finds_what_it_imports(path):
    for cell in code(read(path)):
        tree = compile(cell.source, cell.id, "exec", flags=ast.PyCF_ONLY_AST)
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for name in node.names:
                    importlib.import_module(name.name)
            elif isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module)
                for name in node.names:
                    assert hasattr(module, name.name), f"{path.name}: {node.module} has no {name.name}"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=ids)
def test_links_lead_somewhere(path):
    for cell in read(path).cells:
        if cell.cell_type == "markdown":
            for link in [part.partition(")")[0] for part in cell.source.split("](")[1:]]:
                assert (path.parent / link).exists(), f"{path.name}: {link}"


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=ids)
def test_pages_name_them(path, page):
    assert f"notebooks/{path.name}" in (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Jupyter's own libraries
@pytest.mark.parametrize("path", NOTEBOOKS, ids=ids)
def test_they_run(path):
    client = pytest.importorskip("nbclient").NotebookClient
    notebook = read(path)
    client(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}).execute()
    pictures = [out for cell in code(notebook) for out in cell.outputs if "image/png" in out.get("data", {})]
    assert len(pictures) >= 2
