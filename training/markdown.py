"""Tables for Markdown pages."""

from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    r"""Lay out a table.

    Parameters
    ----------
    header : sequence of str
        Titles of the columns; empty ones may be.
    rows : iterable of sequences of str
        Cells, as many in each row as there are titles. A vertical bar in a cell must be written ``\|``.

    Returns
    -------
    list of str
        Lines.

    Raises
    ------
    ValueError
        If a row is longer or shorter than the header.
    """
    lines = [_line(header), "|---" * len(header) + "|"]
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"the row {list(row)} has {len(row)} cells under the {len(header)} titles {list(header)}")
        lines.append(_line(row))
    return lines


def _line(cells: Sequence[str]) -> str:
    return "".join(f"| {cell} " if cell else "| " for cell in cells) + "|"
