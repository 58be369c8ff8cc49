"""kkl-gym train, and evaluate on what it wrote."""

import re

import pytest

from observers import Artifact
from training.cli import main


def test_train_evaluate_and_report_from_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    toy_sizes = "--trajectories 20 --duration 5 --samples 30 --width 16 --depth 1 --batch 128 --inverse-steps 50"
    main(["train", "van_der_pol", *toy_sizes.split(), "--threads", "1", "--no-monitor"])
    path = tmp_path / "runs" / "van_der_pol" / "van_der_pol.safetensors"
    assert path.exists()
    assert (path.parent / "report.png").stat().st_size > 10_000
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "training an observer for van_der_pol, mu = 3: 2 states, 1 output, 1 input"
    assert lines[1].startswith("pipeline input-aware, preset fast; trajectories = 20; duration = 5.0; ")
    assert lines[2].startswith("20 trajectories of 5 s at dt = 0.01 s; 23 modes of A for each output, from -0.1 to -20")
    wrote = re.fullmatch(r"wrote (\S+) \(0\.\d\d MB\), report\.png and log\.txt beside it, in (\S+) s", lines[-1])
    trained = Artifact.read(path).training["seconds"]  # without the imports and the report
    assert wrote.group(1) == str(path.relative_to(tmp_path))
    assert float(wrote.group(2)) > trained
    logged = (path.parent / "log.txt").read_text().splitlines()
    assert [line.split(" ", 2)[2] for line in logged] == lines
    csv = tmp_path / "errors.csv"
    main(["evaluate", str(path), "--trajectories", "3", "--duration", "8", "--csv", str(csv)])
    assert "2X" in capsys.readouterr().out
    assert len(csv.read_text().splitlines()) == 1 + 3 * 3 * 2
    for wrong in (
        ["train", "nonsense"],
        ["evaluate", "nonsense"],
        ["evaluate"],
        ["train", "lorenz", "--dt", "0"],
        ["train", "lorenz", "--parameters", "rh", "30"],
        ["train", "lorenz", "--threads", "0"],
        ["train", "lorenz", "--out", "/dev/null/x", *toy_sizes.split()],
    ):
        with pytest.raises(SystemExit, match="kkl-gym: "):
            main(wrong)
