"""Markdown tables."""

import pytest

from training.files import table


def test_a_table():
    assert table(["", "one", "two"], [["first", "1", ""], ("second", "–", "3")]) == [
        "| | one | two |",
        "|---|---|---|",
        "| first | 1 | |",
        "| second | – | 3 |",
    ]


def test_rows_are_as_long_as_the_header():
    with pytest.raises(ValueError, match=r"the row \['a'\] has 1 cells under the 2 titles \['x', 'y'\]"):
        table(["x", "y"], [["a"]])
