"""Examples, research and its tests use only public names: no module or attribute that begins with an underscore."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OURS = ("kkl_gym", "observers", "training", "examples")
FILES = [*(ROOT / "examples").rglob("*.py"), *Path(__file__).parent.glob("*.py")]


def private(name):
    return (
        name.startswith("_") and not name.startswith("__") and name not in ("_exit", "_replace")
    )  # os._exit, and named tuples


def used(source):
    """Private names that a file imports from this project, or uses as attributes of objects other than self and cls."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
            yield from (part for name in node.names for part in (*node.module.split("."), name.name) if private(part))
        if isinstance(node, ast.Import):
            yield from (part for name in node.names for part in name.name.split(".") if private(part))
        if isinstance(node, ast.Attribute) and private(node.attr) and ast.unparse(node.value) not in ("self", "cls"):
            yield node.attr


@pytest.mark.parametrize("path", sorted(FILES), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_public_names_are_enough(path):
    assert not list(used(path.read_text(encoding="utf-8")))
