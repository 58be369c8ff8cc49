"""Examples and research use what others may use: names of modules and in them that begin with no underscore."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OURS = ("kkl_gym", "observers", "training", "examples")


@pytest.mark.parametrize("path", sorted((ROOT / "examples").rglob("*.py")), ids=lambda path: path.name)
def test_only_public_names_are_imported(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    ours = [node for node in imports if node.module.split(".")[0] in OURS]
    names = [f"{node.module}.{each.name}" for node in ours for each in node.names]
    assert not [name for name in names if any(part.startswith("_") for part in name.split("."))]
    modules = {each.asname or each.name for node in imports for each in node.names if each.name.islower()}
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    assert not [node.attr for node in used if node.value.id in modules and node.attr.startswith("_")]
