"""docs/background/paper.md: what it names is there."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "background" / "paper.md").read_text()


@cache
def definitions(path):
    """Names that a module defines, those of a class behind a dot."""

    def found(body, prefix=""):
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                yield prefix + node.name
                if isinstance(node, ast.ClassDef):
                    yield from found(node.body, f"{node.name}.")
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                yield from (prefix + target.id for target in targets if isinstance(target, ast.Name))

    return set(found(ast.parse((ROOT / path).read_text()).body))


def test_every_file_and_function_exists():
    named = re.findall(r"`([\w/]+\.py)(?::([\w.]+))?`", PAGE)
    assert len(named) > 80
    assert not [path for path, _ in named if not (ROOT / path).exists()]
    assert not [f"{path}:{name}" for path, name in named if name and name not in definitions(path)]


def test_every_numbered_equation_theorem_and_assumption_of_the_paper_is_there():
    cells = " ".join(line.split("|")[1] for line in PAGE.splitlines() if line.startswith("| "))
    inside_proofs = {32, 33, 34, 35}
    assert set(range(1, 41)) - inside_proofs == {int(number) for number in re.findall(r"(?<!T)\((\d+)\)", cells)}
    for kind, last in (("theorem", 4), ("lemma", 6), ("assumption", 5), ("definition", 4)):
        assert set(range(1, last + 1)) == {int(number) for number in re.findall(rf"{kind} (\d)", cells)}, kind


def test_every_row_has_three_columns():
    rows = [line for line in PAGE.splitlines() if line.startswith("|")]
    assert {len(re.split(r"(?<!\\)\|", row)) for row in rows} == {5}
