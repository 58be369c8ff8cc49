"""The notebooks: whole files without outputs, whose code finds what it imports. `make docs` runs them."""

import ast
import importlib
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
PAGES = [(ROOT / page).read_text(encoding="utf-8") for page in ("docs/start/notebooks.md", "examples/README.md")]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert all(f"notebooks/{path.name}" in page for page in PAGES)
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            for link in [part.partition(")")[0] for part in cell.source.split("](")[1:]]:
                assert (path.parent / link).exists(), link
        else:
            assert not cell.outputs
            assert cell.execution_count is None
            for node in ast.walk(ast.parse(cell.source)):
                if isinstance(node, ast.Import):
                    for name in node.names:
                        importlib.import_module(name.name)
                elif isinstance(node, ast.ImportFrom):
                    module = importlib.import_module(node.module)
                    assert all(hasattr(module, name.name) for name in node.names), ast.unparse(node)
