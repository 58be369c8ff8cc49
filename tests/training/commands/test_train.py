"""kkl-gym train, and evaluate on what it wrote."""

import re

import pytest

from observers import Artifact, Expression, KKLObserver
from training.cli import main
from training.commands.train import Train


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
    assert float(wrote.group(2)) > trained - 0.5  # which is in whole seconds
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


OUTPUTS = """
import numpy as np
from dataclasses import dataclass

from kkl_gym import System
from kkl_gym.elementary import sin


@dataclass(frozen=True)
class Pendulum(System):
    name = "pendulum"
    X = ((-1.0, 1.0), (-1.0, 1.0))
    bounds = ((-50.0, 50.0), (-20.0, 20.0))

    def f(self, x):
        return x[1], -sin(x[0]) - 0.1 * x[1]

    def h(self, x):
        return (sin(x[0]),)


class OnFloats(Pendulum):
    name = "on-floats"

    def h(self, x):
        return (np.sin(x[0]),)
"""


def test_outputs_that_are_not_linear_are_written_down_or_it_is_said_why_not(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OUTPUTS)
    sizes = "--trajectories 5 --duration 1 --samples 5 --width 8 --depth 1 --batch 64 --inverse-steps 2 --no-monitor"
    for name, said in (("Pendulum", False), ("OnFloats", True)):
        main(["train", f"own.py:{name}", *sizes.split(), "--out", name])
        lines = [line for line in capsys.readouterr().out.splitlines() if "cannot hold h(x)" in line]
        assert len(lines) == said
    assert "own.py, line" in lines[0]
    assert "kkl_gym.elementary" in lines[0]
    artifact = Artifact.read("Pendulum/pendulum.safetensors")
    assert artifact.h == Expression([["sin", ["x", 0]]])
    with pytest.raises(ValueError, match=r"holds no limits .* training\.calibrate\(artifact, system\) finds them"):
        KKLObserver(artifact, monitor=True)


def test_a_small_map_has_narrow_layers_and_a_name_of_its_own(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sizes = "--trajectories 20 --duration 2 --samples 30 --depth 1 --batch 64 --inverse-steps 2 --no-monitor"
    main(["train", "van_der_pol", "--size", "small", "--no-inputs", *sizes.split()])
    path = tmp_path / "runs" / "van_der_pol-small" / "van_der_pol-small.safetensors"
    assert Artifact.read(path).inverse.mlp.weights[0].shape[0] == 20
    assert len(Artifact.read(path).filter.A) == 15  # without the default's pairs of slow modes
    assert "width = 20" in capsys.readouterr().out
    assert Train("van_der_pol", size="small", settings={"width": 8})._changes() == {"width": 8, "pairs": ()}
    with pytest.raises(SystemExit, match="--size is of no use with --data"):
        main(["train", "--data", "runs.csv", "--size", "small"])
