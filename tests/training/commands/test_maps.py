"""``kkl-gym maps``."""

import io

from rich.console import Console

from observers import shipped
from training.commands.maps import Maps


def printed(width):
    out = io.StringIO()
    Maps().run(Console(file=out, width=width))
    return out.getvalue()


def test_one_row_for_each_file_and_no_name_cut():
    files = set(shipped().values())
    assert len(files) < len(shipped())
    narrow = printed(80)
    assert "…" not in narrow
    words = narrow.split()
    for file in files:
        assert words.count(file) == 1
    for name in set(shipped()) - files:
        assert words.count(f"({name})") == 1
    assert max(map(len, narrow.splitlines())) <= 80
    assert printed(40).split() == words


def test_what_each_map_is_told():
    rows = {line.split()[0]: line.split() for line in printed(120).splitlines() if line.strip()}
    assert rows["van_der_pol-v2"][1:] == ["(van_der_pol)", "input-aware*", "1", "23", "1", "0.05", "0.36"]
    assert rows["van_der_pol-small-v2"][1:] == ["(van_der_pol-small)", "input-aware*", "1", "15", "1", "0.05", "0.05"]
    assert rows["lorenz-spinn-v2"][1:] == ["(lorenz-spinn)", "spinn", "0", "9", "1", "–", "0.28"]
