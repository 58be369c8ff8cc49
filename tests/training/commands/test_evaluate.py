"""``kkl-gym evaluate``."""

from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from training.cli import main
from training.commands.evaluate import Evaluate

COLUMNS = "observer,starts,driven,process_noise,measurement_noise,trajectory,smape,smape_late"
RESULTS = Path(__file__).parents[3] / "docs" / "results"


@pytest.mark.parametrize("option", ["--measurement-noise", "--noise"])
def test_every_column_of_the_csv_file_holds_one_thing(option, saved, tmp_path):
    path, csv = saved(), tmp_path / "new" / "errors.csv"
    main(["evaluate", path, "--trajectories", "2", "--duration", "2", option, "0", "0.3", "--process-noise", "0.1",
          "--csv", str(csv)])  # fmt: skip
    assert csv.read_text().splitlines()[0] == COLUMNS
    found = pd.read_csv(csv)
    assert len(found) == 3 * 2 * 2
    assert set(found.observer) == {path}
    cases = found[["starts", "driven"]].drop_duplicates()
    assert list(cases.itertuples(index=False, name=None)) == [("X", False), ("2X \\ X", False), ("X", True)]
    assert set(found.process_noise) == {0.1}
    assert found.measurement_noise.tolist() == 3 * [0.0, 0.0, 0.3, 0.3]
    assert found.trajectory.tolist() == 6 * [0, 1]


@pytest.mark.parametrize("inputs", [False, True])
@pytest.mark.parametrize("process_noise", [0.0, 0.1])
def test_every_column_of_the_printed_table_holds_one_thing(inputs, process_noise, saved):
    console = Console(width=200, record=True)
    Evaluate((saved(inputs=inputs),), process_noise=process_noise, trajectories=2, duration=2.0).run(console)
    title, table = console.export_text().split("┏")
    assert "noise" not in title
    names = [line.split("┃")[1:-1] for line in table.splitlines() if line.startswith("┃")]
    header = [" ".join(" ".join(lines).split()) for lines in zip(*names, strict=True)]
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in table.splitlines() if line.startswith("│")]
    driven, process = ["driven"] * inputs, ["process noise"] * (process_noise > 0)
    assert header == ["starts", *driven, *process, "noise on y", "all steps", "after transient", "escaped"]
    cases = [["X", "no"], ["2X \\ X", "no"], ["X", "yes"]] if inputs else [["X"], ["2X \\ X"]]
    level = ["0.1"] if process_noise else []
    assert [row[:-3] for row in rows] == [[*case, *level, noise] for case in cases for noise in ("0", "0.5")]


@pytest.mark.parametrize(("name", "process_noise"), [("accuracy", 0.0), ("accuracy-process-noise", 0.05)])
def test_published_errors_have_the_same_columns(name, process_noise):
    path = RESULTS / f"{name}.csv"
    assert path.read_text().splitlines()[0] == COLUMNS
    found = pd.read_csv(path)
    assert set(found.starts) == {"X", "2X \\ X"}
    assert set(found.process_noise) == {process_noise}
    assert set(found.measurement_noise) == {0.0, 0.5}
    assert found.driven.dtype == bool
    assert (found.groupby(["observer", "starts", "driven", "measurement_noise"]).size() >= 97).all()
