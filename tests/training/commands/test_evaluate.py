"""``kkl-gym evaluate``."""

from pathlib import Path

import pandas as pd
import pytest

from training.cli import main

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
