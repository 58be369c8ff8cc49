"""``kkl-gym train``, and ``kkl-gym evaluate`` on the trained files."""

import re
from pathlib import Path

import gymnasium as gym
import linear_system
import numpy as np
import pandas as pd
import pytest
import unstable_system
from recorded_runs import SMALL, as_csv, swing

import kkl_gym
from observers import Artifact, load
from training.cli import main

OSCILLATOR, FALLING = f"{linear_system.__file__}:Oscillator", f"{unstable_system.__file__}:Falling"
TINY = {"trajectories": 20, "duration": 5, "samples": 20, "width": 8, "depth": 1, "batch": 64, "inverse_steps": 9}
SIZES = ["--set", *(f"{name}={value}" for name, value in {**TINY, "dt": 0.1, "runs": 100}.items())]


class OnFloats(linear_system.Autonomous):
    name = "on-floats"

    def h(self, x):
        return (np.sin(x[0]),)


def hold(x):
    """A policy that stabilises the plant."""
    return np.clip(-1.6 * x[:, :1] - 0.8 * x[:, 1:], -1, 1)


def lines(capsys):
    """Printed lines without progress lines, which slow machines print."""
    return [line for line in capsys.readouterr().out.splitlines() if " passed" not in line]


def test_from_a_system_to_an_observer_that_tracks(capsys):
    main(["train", OSCILLATOR, *SIZES])
    path = Path("runs/oscillator/oscillator.safetensors")
    assert path.with_name("report.png").stat().st_size > 10_000
    printed = lines(capsys)
    assert printed[0] == "training an observer for oscillator: 2 states, 1 output, 1 input"
    assert printed[1].startswith("pipeline input-aware, preset fast, size default; ")
    assert re.fullmatch(r"20 trajectories of 5 s at dt = 0.1 s; \d+ modes of A .*", printed[2])
    assert re.fullmatch(r"CPU seconds: motions \S+, free \S+, inverse \S+, calibrating \S+", printed[3])
    assert printed[4] == "the observer tracks by the system's equations; T_inv initialises it"
    assert re.fullmatch(rf"wrote {path} \(0\.\d\d MB\), report\.png and log\.txt beside it, in \S+", printed[5])
    evaluation = re.fullmatch(r"kkl-gym (evaluate .*) measures the observer's errors", printed[6])[1].split()
    assert printed[7:] == []
    logged = [line.split(" ", 2)[2] for line in path.with_name("log.txt").read_text().splitlines()]
    assert [line for line in logged if " passed" not in line] == printed
    artifact = Artifact.read(path)
    assert artifact.motion.equations is not None
    assert artifact.limits is not None
    main([*evaluation, "--trajectories", "3", "--duration", "8"])
    assert "2X" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"runs.oscillator holds the checkpoints of a run"):
        main(["train", OSCILLATOR, *SIZES])
    main(["train", OSCILLATOR, *SIZES, "--resume"])
    assert lines(capsys)[0] == printed[0]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (["inputs=false", "--size", "large"], "oscillator-large"),
        (["forward_steps=9", "eigenvalues=-5,-6,-7", "--pipeline", "spinn"], "oscillator-spinn"),
    ],
)
def test_other_kinds_have_names_of_their_own(options, name, capsys):
    main(["train", OSCILLATOR, *SIZES, *options])
    artifact = Artifact.read(f"runs/{name}/{name}.safetensors")
    assert (artifact.forward is None) == (artifact.motion is not None) == ("large" in name)
    begin = "the observer tracks by the system's equations" if "large" in name else "the observer is T_inv alone"
    assert any(line.startswith(begin) for line in lines(capsys))


def test_commands_follow_an_unstable_plant_under_the_policy_of_its_training(capsys):
    main(["train", FALLING, "--policy", f"{__file__}:hold", *SIZES])
    assert lines(capsys)[-1].endswith(f"--system {FALLING} --policy {__file__}:hold measures the observer's errors")
    path, short = "runs/falling/falling.safetensors", ["--trajectories", "4", "--duration", "6"]
    for command in (
        ["evaluate", path, "--system", FALLING, *short, "--measurement-noise", "0", "--csv", "errors.csv"],
        ["evaluate", path, "--system", FALLING, *short, "--measurement-noise", "0.01", "--faults"],
    ):
        with pytest.raises(SystemExit, match="--policy"):
            main(command)
        main([*command, "--policy", f"{__file__}:hold"])
    found = pd.read_csv("errors.csv")
    assert (found.starts == "X").sum() == 8  # no run escaped
    assert set(found.driven) == {True, False}


def test_from_records_to_an_observer_that_tracks(capsys):
    files = [as_csv(f"run{seed}.csv", swing(seed, n=200, jitter=0.1)) for seed in range(5)]
    quick = {**SMALL, "inverse_steps": 30, "flow_steps": 30}
    Path("quick.toml").write_text("\n".join(f"{name} = {value}" for name, value in quick.items()))
    columns = ["--measured", "position", "--inputs", "force"]
    command, path = (
        ["train", "spring", "--data", *files, *columns, "--config", "quick.toml"],
        "runs/spring/spring.safetensors",
    )
    main([*command, "--hidden", "position,speed"])
    printed = lines(capsys)
    start = (
        "training an observer for spring from recorded states: position, speed from position and force; 5 records of"
    )
    assert printed[0].startswith(f"{start} 49.75 s together, in steps of 0.05")
    assert re.search(r"\(median\), uneven by up to 19.\d%; resampled to 0.05 s$", printed[0])
    assert "the observer tracks by a learned flow; T_inv initialises it" in printed
    assert printed[-2].startswith("rms error / standard deviation on held-out records: position ")
    assert printed[-1].startswith(f"wrote {path} ")
    assert Path("runs/spring/report.png").stat().st_size > 10_000
    assert load(path).estimate(np.zeros((10, 1)), np.zeros((9, 1))).shape == (10, 2)
    with pytest.raises(ValueError, match=r"'spring' was learned from recorded states.*fits no environment"):
        kkl_gym.KKLObservation(gym.make("KKLVanDerPol-v0"), path)
    with pytest.raises(SystemExit, match="'spring' was learned from recorded states"):
        main(["evaluate", path])
    main([*command, "--hidden", "speed", "--set", "held_out=0", "--out", "whole"])
    printed = lines(capsys)
    assert "the observer is T_inv alone, without covariances" in printed
    assert "on held-out records: unknown, as they hold too few samples (after" in printed[-2]
    assert Path("whole/report.png").exists()
