"""``kkl-gym train``, and ``kkl-gym evaluate`` on what it wrote."""

import re
from functools import partial
from pathlib import Path

import gymnasium as gym
import linear_system
import numpy as np
import pandas as pd
import pytest
import unstable_system
from recorded_runs import SMALL, as_csv, swing

import kkl_gym
from kkl_gym.elementary import sin
from observers import Artifact, Expression, KKLObserver, load
from training.cli import main
from training.teaching import monitor

SMALL_RUN = {"trajectories": 20, "duration": 5, "samples": 20, "width": 8, "depth": 1, "batch": 64, "inverse-steps": 9}
FALLING = f"{unstable_system.__file__}:Falling"
SIZES = [f"--{name}={value}" for name, value in SMALL_RUN.items()]


class Sine(linear_system.Autonomous):
    name = "sine"

    def h(self, x):
        return (sin(x[0]),)


class OnFloats(linear_system.Autonomous):
    name = "on-floats"

    def h(self, x):
        return (np.sin(x[0]),)


def hold(x):
    """Keep it from falling."""
    return np.clip(-1.6 * x[:, :1] - 0.8 * x[:, 1:], -1, 1)


def test_from_a_system_to_an_observer(capsys):
    main(["train", "van_der_pol", *SIZES, "--threads", "1", "--no-monitor"])
    path = Path("runs/van_der_pol/van_der_pol.safetensors")
    assert path.with_name("report.png").stat().st_size > 10_000
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "training an observer for van_der_pol, mu = 3: 2 states, 1 output, 1 input"
    assert lines[1].startswith("pipeline input-aware, preset fast; trajectories = 20; duration = 5.0; ")
    assert lines[2].startswith("20 trajectories of 5 s at dt = 0.01 s; 23 modes of A for each output, from -0.1 to -20")
    wrote = re.fullmatch(r"wrote (\S+) \(0\.\d\d MB\), report\.png and log\.txt beside it, in (\S+) s", lines[-1])
    assert wrote.group(1) == str(path)
    assert float(wrote.group(2)) > Artifact.read(path).training["seconds"] - 0.5  # which are whole seconds
    logged = path.with_name("log.txt").read_text().splitlines()
    assert [line.split(" ", 2)[2] for line in logged] == lines
    main(["evaluate", str(path), "--trajectories", "3", "--duration", "8"])
    assert "2X" in capsys.readouterr().out


def test_a_small_map_has_narrow_layers_and_a_name_of_its_own(capsys):
    sizes = [size for size in SIZES if not size.startswith("--width")]
    main(["train", "van_der_pol", "--size", "small", "--no-inputs", *sizes, "--no-monitor"])
    artifact = Artifact.read("runs/van_der_pol-small/van_der_pol-small.safetensors")
    assert artifact.inverse.mlp.weights[0].shape[0] == 20
    assert len(artifact.filter.A) == 15  # without the default's pairs of slow modes
    assert "width = 20" in capsys.readouterr().out


def test_outputs_that_are_not_linear_are_written_down_or_it_is_said_why_not(capsys):
    for name, said in (("Sine", False), ("OnFloats", True)):
        main(["train", f"{__file__}:{name}", *SIZES, "--no-monitor", "--out", name])
        lines = [line for line in capsys.readouterr().out.splitlines() if "cannot hold h(x)" in line]
        assert len(lines) == said
    assert "test_train.py, line" in lines[0]
    assert "kkl_gym.elementary" in lines[0]
    artifact = Artifact.read("Sine/sine.safetensors")
    assert artifact.h == Expression([["sin", ["x", 0]]])
    with pytest.raises(ValueError, match=r"holds no limits .* training\.calibrate\(artifact, system\) finds them"):
        KKLObserver(artifact, monitor=True)


def test_commands_follow_an_unstable_plant_under_the_policy_of_its_training(monkeypatch, capsys):
    monkeypatch.setattr(monitor, "calibrate", partial(monitor.calibrate, duration=6.0))
    main(["train", FALLING, "--policy", f"{__file__}:hold", *SIZES])
    assert "no limits" not in capsys.readouterr().out
    path, system = "runs/falling/falling.safetensors", ["--system", FALLING]
    for command in (
        [
            "evaluate",
            path,
            *system,
            *["--trajectories", "4", "--duration", "6", "--measurement-noise", "0", "--csv", "errors.csv"],
        ],
        ["faults", path, *system, *["--trajectories", "4", "--duration", "6", "--measurement-noise", "0.01"]],
    ):
        with pytest.raises(SystemExit, match="--policy"):
            main(command)
        main([*command, "--policy", f"{__file__}:hold"])
    found = pd.read_csv("errors.csv")
    assert (found.starts == "X").sum() == 8  # nothing escaped
    assert set(found.driven) == {True, False}


def test_the_systems_own_controller_needs_no_option():
    main(["train", FALLING, "--policy", "controller", "--no-monitor", *SIZES, "--out", "."])
    options = f"--system {FALLING} --trajectories 5 --duration 6 --measurement-noise 0 --csv errors.csv"
    main(["evaluate", "falling.safetensors", *options.split()])
    assert (pd.read_csv("errors.csv").starts == "X").sum() == 10


def test_from_recorded_files_to_an_observer(capsys):
    files = [as_csv(f"run{seed}.csv", swing(seed, n=200, jitter=0.1)) for seed in range(5)]
    quick = [f"--{name.replace('_', '-')}={value}" for name, value in {**SMALL, "inverse_steps": 30}.items()]
    columns = ["--measured", "position", "--inputs", "force", "--hidden", "speed"]
    command, path = ["train", "spring", "--data", *files, *columns, *quick], "runs/spring/spring.safetensors"
    main(command)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "training an observer for spring from recorded states: speed from position and force"
    assert lines[1] == "5 records of 49.75 s together, 0 rows without an output"
    assert re.fullmatch(r"steps of 0.050\d+ s \(median\), uneven by up to 19.\d%; resampled to 0.05 s", lines[2])
    assert "rms error over standard deviation on what was held out: speed " in lines[-2]
    assert lines[-1].startswith(f"wrote {path} (0.01 MB), report.png and log.txt")
    assert Path("runs/spring/report.png").stat().st_size > 10_000
    observer = load(path)
    assert observer.measurement_noise == 0.0
    assert observer.estimate(np.zeros((10, 1)), np.zeros((9, 1))).shape == (10, 1)
    with pytest.raises(ValueError, match=r"'spring' was learned from recorded states.*fits no environment"):
        kkl_gym.KKLObservation(gym.make("KKLVanDerPol-v0"), path)
    with pytest.raises(SystemExit, match="'spring' was learned from recorded states"):
        main(["evaluate", path])
    main([*command, "--resume"])
    with pytest.raises(SystemExit, match=r"runs.spring holds the checkpoints of a run"):
        main(command)
