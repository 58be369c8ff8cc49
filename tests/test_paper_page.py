"""docs/background/paper.md goes through the whole paper; ``test_pages.py`` looks up what it names."""

import re
from pathlib import Path

ROWS = [
    line
    for line in (Path(__file__).parents[1] / "docs" / "background" / "paper.md").read_text().splitlines()
    if line.startswith("|")
]


def test_every_numbered_equation_theorem_and_assumption_of_the_paper_is_there():
    assert {len(re.split(r"(?<!\\)\|", row)) for row in ROWS} == {5}  # three columns
    cells = " ".join(row.split("|")[1] for row in ROWS)
    inside_proofs = {32, 33, 34, 35}
    assert set(range(1, 41)) - inside_proofs == {int(number) for number in re.findall(r"(?<!T)\((\d+)\)", cells)}
    for kind, last in (("theorem", 4), ("lemma", 6), ("assumption", 5), ("definition", 4)):
        assert set(range(1, last + 1)) == {int(number) for number in re.findall(rf"{kind} (\d)", cells)}, kind
