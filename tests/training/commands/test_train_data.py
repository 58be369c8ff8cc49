"""kkl-gym train --data: an observer from recorded states."""

import re

import gymnasium as gym
import numpy as np
import pytest
from recorded_runs import SMALL, as_csv, swing

import kkl_gym
from observers import load
from training.cli import main

COLUMNS = ["--measured", "position", "--inputs", "force", "--hidden", "speed"]
QUICK = [f"--{name.replace('_', '-')}={value}" for name, value in {**SMALL, "inverse_steps": 30}.items()]


def test_from_files_to_an_observer(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = [as_csv(tmp_path / f"run{seed}.csv", swing(seed, n=200, jitter=0.1)) for seed in range(5)]
    main(["train", "spring", "--data", *files, *COLUMNS, *QUICK])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "training an observer for spring from recorded states: speed from position and force"
    assert lines[1] == "5 records of 49.75 s together, 0 rows without an output"
    assert re.fullmatch(r"steps of 0.050\d+ s \(median\), uneven by up to 19.\d%; resampled to 0.05 s", lines[2])
    assert "rms error over standard deviation on what was held out: speed " in lines[-2]
    assert lines[-1].startswith("wrote runs/spring/spring.safetensors (0.01 MB), report.png and log.txt")
    assert (tmp_path / "runs/spring/report.png").stat().st_size > 10_000
    observer = load("runs/spring/spring.safetensors")
    assert observer.measurement_noise == 0.0
    assert observer.estimate(np.zeros((10, 1)), np.zeros((9, 1))).shape == (10, 1)
    with pytest.raises(ValueError, match=r"'spring' was learned from recorded states.*fits no environment"):
        kkl_gym.KKLObservation(gym.make("KKLVanDerPol-v0"), "runs/spring/spring.safetensors")
    with pytest.raises(SystemExit, match="'spring' was learned from recorded states"):
        main(["evaluate", "runs/spring/spring.safetensors"])
    main(["train", "spring", "--data", *files, *COLUMNS, *QUICK, "--resume"])
    with pytest.raises(SystemExit, match=r"runs.spring holds the checkpoints of a run"):
        main(["train", "spring", "--data", *files, *COLUMNS, *QUICK])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["spring", "--data", "FILE", "--measured", "angle"], r"FILE has no column angle; .*\(--measured\)"),
        (["spring", "--data", "FILE", "--measured", "position"], r"no hidden states were recorded"),
        (["spring", "--data", "nowhere.csv"], "there is no file nowhere.csv"),
        (["spring", "--data", "FILE", *COLUMNS, "--trajectories", "5"], "--trajectories: of no use with --data"),
        (
            ["spring", "--data", "FILE", *COLUMNS, "--dt", "-1"],
            "dt must be a positive, finite number .*, got -1.0",
        ),
        (["spring", "--data", "FILE", *COLUMNS, "--dt", "5000"], "remembers|must be positive"),
        (["spring", "--data", "FILE", *COLUMNS, "--pipeline", "spinn"], "--pipeline is of no use with --data"),
        (["spring", "--data", "FILE", *COLUMNS, "--dry-run"], "--dry-run is of no use with --data"),
        (["../spring", "--data", "FILE", *COLUMNS], "SYSTEM is a name of your choice"),
        (["van_der_pol", "--members", "3"], r"--members needs recorded data \(--data\)"),
        (["van_der_pol", "--hidden", "x"], r"--hidden needs recorded data \(--data\)"),
        ([], r"name a system, or recorded data \(--data\)"),
    ],
)
def test_refusals_are_one_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    as_csv("FILE.csv", swing(0, n=200))
    with pytest.raises(SystemExit, match=message.replace("FILE", "FILE.csv")) as caught:
        main(["train", *(argument.replace("FILE", "FILE.csv") for argument in arguments)])
    assert "\n" not in str(caught.value)


def test_bad_data_is_named(tmp_path):
    path = tmp_path / "bad.csv"
    as_csv(path, swing(0, n=200))
    rows = path.read_text().splitlines()
    for row, changed, message in (
        (5, "1,2,3", "bad.csv: row 5 has 3 cells, the header 4"),
        (9, rows[3], "bad.csv: column time, row 9: time must increase"),
        (4, "0.15,much,0,0", "bad.csv: column position, row 4: 'much' is no number"),
    ):
        path.write_text("\n".join([*rows[:row], changed, *rows[row + 1 :]]))
        with pytest.raises(SystemExit, match=message):
            main(["train", "spring", "--data", str(path), *COLUMNS, "--out", str(tmp_path / "out")])
