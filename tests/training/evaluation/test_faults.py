"""Sensor faults, on a small scale."""

from pathlib import Path

import pandas as pd
import pytest

from training import files
from training.cli import main
from training.commands.evaluate import FAULTS_HEADER, fault_rows
from training.evaluation.faults import FAULTS

COLUMNS = "observer,system,fault,deadline,trajectory,score,delay"


def test_the_command_and_its_report(tmp_path, capsys):
    path = str(tmp_path / "faults.csv")
    main(["evaluate", "lorenz", "--faults", "--trajectories", "12", "--duration", "16", "--csv", path])
    assert "noticed" in capsys.readouterr().out
    found = pd.read_csv(path)
    assert ",".join(found) == COLUMNS
    assert found.groupby("fault", sort=False).size().to_dict() == dict.fromkeys(FAULTS, 12)
    assert set(found.observer) == set(found.system) == {"lorenz"}
    assert set(found.deadline) == {2.0}
    sound, bias = found[found.fault == "none"], found[found.fault == "bias"]
    assert (sound.score > 0).all()
    assert (sound.score < 1).mean() > 0.8
    assert (bias.score > 1).all()  # the bias, a fifth of Lorenz's range, is 9
    assert (bias.delay < 0.5).all()
    for fault in FAULTS[1:]:
        here = found[found.fault == fault]
        assert (here.delay[here.score > 1] <= 2.0).all()
    assert [row[0] for row in fault_rows(found)] == 3 * ["lorenz"]
    assert fault_rows(found)[0][2:5] == ["bias", "2 s", "100.0 %"]
    for wrong, message in (("--trajectories=1", "at least 2, got 1"), ("--duration=3", "4 s to simulate faults, got")):
        with pytest.raises(SystemExit, match=message):
            main(["evaluate", "lorenz", "--faults", wrong])


def test_the_table_on_the_page_is_that_of_the_file():
    results = Path(__file__).parents[3] / "docs" / "results"
    published = pd.read_csv(results / "faults" / "faults.csv")
    assert ",".join(published) == COLUMNS
    assert "\n".join(files.table(["", *FAULTS_HEADER], fault_rows(published))) in (results / "faults.md").read_text()
