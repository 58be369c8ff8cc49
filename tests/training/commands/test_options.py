"""Observers that were trained under a policy, in the commands."""

from functools import partial

import pandas as pd
import pytest

from training.cli import main
from training.teaching import monitor

SCRIPT = """
from dataclasses import dataclass
import numpy as np
from unstable_system import Falling as Plant

@dataclass(frozen=True)
class Falling(Plant):
    name = "falling_in_a_script"

def hold(x):
    return np.clip(-1.6 * x[:, :1] - 0.8 * x[:, 1:], -1, 1)
"""
SMALL = "--trajectories 20 --duration 5 --samples 20 --width 4 --depth 1 --batch 64 --inverse-steps 9"


def test_commands_follow_an_unstable_plant_under_the_policy_of_its_training(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(monitor, "calibrate", partial(monitor.calibrate, duration=6.0))
    (tmp_path / "mine.py").write_text(SCRIPT)
    main(["train", "mine.py:Falling", "--policy", "mine.py:hold", *SMALL.split()])
    assert "no limits" not in capsys.readouterr().out
    path = "runs/falling_in_a_script/falling_in_a_script.safetensors"
    system = ["--system", "mine.py:Falling"]
    sizes = {
        "evaluate": "--trajectories 8 --duration 6 --measurement-noise 0 --csv errors.csv",
        "certify": "--trajectories 8 --measurement-noise 0.01",
        "faults": "--trajectories 4 --duration 6 --measurement-noise 0.01",
    }
    for command, small in sizes.items():
        with pytest.raises(SystemExit, match="--policy"):
            main([command, path, *system, *small.split()])
        main([command, path, *system, *small.split(), "--policy", "mine.py:hold"])
    found = pd.read_csv("errors.csv")
    assert (found.starts == "X").sum() == 16  # nothing escaped
    assert set(found.driven) == {True, False}


def test_the_systems_own_controller_needs_no_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(SCRIPT)
    main(["train", "mine.py:Falling", "--policy", "controller", "--no-monitor", *SMALL.split()])
    path = "runs/falling_in_a_script/falling_in_a_script.safetensors"
    small = "--trajectories 5 --duration 6 --measurement-noise 0 --csv errors.csv"
    main(["evaluate", path, "--system", "mine.py:Falling", *small.split()])
    assert (pd.read_csv("errors.csv").starts == "X").sum() == 10


def test_an_observer_without_inputs_takes_no_policy(saved):
    with pytest.raises(SystemExit, match="takes none"):
        main(["evaluate", saved(inputs=False), "--policy", "controller"])
