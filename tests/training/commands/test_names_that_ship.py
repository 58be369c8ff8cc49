"""``kkl-gym maps``."""

import io

from rich.console import Console

from observers import shipped
from training.commands.maps import Maps


def test_maps_has_a_row_for_each_file_and_cuts_no_name():
    def printed(width):
        Maps().run(Console(file=(out := io.StringIO()), width=width))
        return out.getvalue()

    words = printed(80).split()
    assert printed(40).split() == words
    assert all(words.count(name) == 1 for name in shipped())
    assert max(map(len, printed(80).splitlines())) <= 80
    rows = {line.split()[0]: line.split() for line in printed(120).splitlines() if line.strip()}
    assert rows["van_der_pol"][1:] == ["input-aware", "equations", "1", "15", "1", "0.05", "0.04"]
    assert rows["lorenz-spinn"][1:] == ["spinn", "–", "0", "9", "1", "–", "0.29"]
