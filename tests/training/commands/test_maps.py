"""``kkl-gym maps``."""

import io

from rich.console import Console

from observers import shipped
from training.commands.maps import Maps


def printed(width):
    out = io.StringIO()
    Maps().run(Console(file=out, width=width))
    return out.getvalue()


def test_one_row_for_each_map_and_no_name_cut():
    narrow = printed(80)
    assert "…" not in narrow
    words = narrow.split()
    for name in shipped():
        assert words.count(name) == 1
    assert max(map(len, narrow.splitlines())) <= 80
    assert printed(40).split() == words


def test_what_each_map_is_told():
    rows = {line.split()[0]: line.split() for line in printed(120).splitlines() if line.strip()}
    assert rows["van_der_pol"][1:] == ["input-aware*", "1", "23", "1", "0.05", "0.36"]
    assert rows["van_der_pol-small"][1:] == ["input-aware*", "1", "15", "1", "0.05", "0.05"]
    assert rows["lorenz-spinn"][1:] == ["spinn", "0", "9", "1", "–", "0.28"]
