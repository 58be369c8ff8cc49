"""``kkl-gym maps``, and each command that takes a map's name takes one that ships, however it estimates."""

import io

import pandas as pd
import pytest
from rich.console import Console

from observers import shipped
from training.cli import main
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


@pytest.mark.parametrize("name", ["lorenz", "lorenz-large"])
@pytest.mark.parametrize(
    ("command", "work"),
    [
        ("identify lorenz --observer NAME --data y.csv", "training.identification.adapt"),
        ("evaluate NAME --trajectories 2 --duration 1 --no-tracking", None),
        ("evaluate NAME --calibration --trajectories 2 --duration 1 --measurement-noise 0.5", None),
        ("evaluate NAME --faults --trajectories 2 --duration 4", None),
        ("export NAME --format c", None),
        ("demo lorenz --observer NAME --duration 1", None),
        ("agent train lorenz --observer NAME --timesteps 1", "training.agents.learning.learn"),
    ],
)
def test_a_name_that_ships_works_in_every_command(command, work, name, monkeypatch):
    pd.DataFrame({"t": [0.0, 0.01], "y": [0.0, 1.0]}).to_csv("y.csv", index=False)
    words = command.replace("NAME", name).split()
    if work is None:
        main(words)
        return

    def begun(*arguments, **options):
        raise ValueError("the work has begun")

    monkeypatch.setattr(work, begun)
    with pytest.raises(SystemExit, match="the work has begun"):
        main(words)
