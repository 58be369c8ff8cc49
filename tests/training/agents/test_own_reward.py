"""Agents learn from a reward that the system defines."""

import csv
from pathlib import Path

from training.cli import main

SCRIPT = Path(__file__).parents[3] / "examples" / "own_task.py"


def test_agents_of_a_system_with_a_reward_are_paid_that(tmp_path, capsys):
    main(["agent", "train", str(SCRIPT), "--information", "y", "--timesteps", "1", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "holds the target" not in printed
    mean = float(printed.partition("rewards)")[2].partition("±")[0].strip(" │"))
    trained_on = [float(row["return"]) for row in csv.DictReader((tmp_path / "curve.csv").read_text().splitlines())]
    assert min([mean, *trained_on]) > 0.0  # the default reward, minus the cost, is below zero
    assert mean < 2000.0
