"""``kkl-gym evaluate``."""

import dataclasses
import io
from pathlib import Path

import discrete_systems
import linear_system
import numpy as np
import pandas as pd
import pytest
from error_bars import with_error_bars
from rich.console import Console
from tracking import tracking_observer

from training.cli import main
from training.commands.evaluate import Evaluate, Motions


class Cornered(linear_system.Oscillator):
    name = "oscillator"
    bounds = ((-1, 1), (-1, 1))


class Unstable(linear_system.Oscillator):
    name = "oscillator"

    def f(self, x):
        return 5 * x[0], 5 * x[1]


COLUMNS = "observer,starts,driven,process_noise,measurement_noise,trajectory,smape,smape_late"


def evaluate(*observers, **options):
    """An Evaluate command with options of all groups."""
    motions = {one.name: options.pop(one.name) for one in dataclasses.fields(Motions) if one.name in options}
    return Evaluate(observers, motions=Motions(**motions), **options)


def printed(*observers, **options):
    """The printed tables, each a header and rows of cells, and all other printed lines."""
    console = Console(width=200, record=True, file=io.StringIO())
    evaluate(*observers, **options).run(console)
    headers, rows, below = [], [], []
    for line in console.export_text().splitlines():
        if line.startswith("┏"):
            headers.append([])
            rows.append([])
        elif line.startswith("┃"):
            headers[-1].append(line.split("┃")[1:-1])
        elif line.startswith("│"):
            rows[-1].append([cell.strip() for cell in line.split("│")[1:-1]])
        elif not line.startswith(("┡", "└", "├")):
            below.append(line.strip())
    joined = [[" ".join(" ".join(lines).split()) for lines in zip(*names, strict=True)] for names in headers]
    return [[header, *each] for header, each in zip(joined, rows, strict=True)], below


def test_every_column_of_the_csv_file_holds_one_thing(saved):
    path = saved()
    options = "--trajectories 2 --duration 2 --measurement-noise 0 0.3 --process-noise 0.1 --csv new/errors.csv"
    main(["evaluate", path, *options.split()])
    assert Path("new/errors.csv").read_text().splitlines()[0] == f"{COLUMNS},nrmse1,nrmse2"
    found = pd.read_csv("new/errors.csv")
    assert len(found) == 3 * 2 * 2
    assert set(found.observer) == {path}
    cases = found[["starts", "driven"]].drop_duplicates()
    assert list(cases.itertuples(index=False, name=None)) == [("X", False), ("2X \\ X", False), ("X", True)]
    assert set(found.process_noise) == {0.1}
    assert found.measurement_noise.tolist() == 3 * [0.0, 0.0, 0.3, 0.3]
    assert found.trajectory.tolist() == 6 * [0, 1]


def test_every_column_of_the_printed_tables_holds_one_thing(saved):
    (smape, nrmse), _ = printed(saved(inputs=False), trajectories=2, duration=2.0)
    assert smape[0] == ["starts", "noise on y", "all steps", "after transient", "escaped"]
    assert nrmse[0] == ["starts", "noise on y", "x1", "x2"]
    keys = [[starts, noise] for starts in ("X", "2X \\ X") for noise in ("0", "0.5")]
    assert [row[:2] for row in smape[1:]] == [row[:2] for row in nrmse[1:]] == keys
    both = {"ekf": True, "limit": True}
    (smape, nrmse), _ = printed(saved(), process_noise=0.1, trajectories=2, duration=1.0, **both)
    assert smape[0][:5] == nrmse[0][:5] == ["observer", "starts", "driven", "process noise", "noise on y"]
    cases = [["X", "no"], ["2X \\ X", "no"], ["X", "yes"]]
    who = [Path(saved()).stem, "exact EKF", "limit"]
    keys = [[each, *case, "0.1", noise] for case in cases for noise in ("0", "0.5") for each in who]
    keys = [key for key in keys if key[:2] != ["limit", "2X \\ X"]]  # starts with unknown variance have no limit
    assert [row[:5] for row in smape[1:]] == [row[:5] for row in nrmse[1:]] == keys


def test_runs_of_another_plant_than_the_model():
    """The oscillator has the rate 1 in the exact observer's model, and the rate 2 as the plant."""
    path = "map.safetensors"
    dataclasses.replace(linear_system.exact_observer(name="turning"), parameters={"omega": 1.0, "gain": 1.0}).save(path)
    options = {"trajectories": 4, "duration": 30.0, "measurement_noise": (0.0,)}
    options["system"] = f"{discrete_systems.__file__}:Turning"
    (right, _), _ = printed(path, **options)
    (off, _), _ = printed(path, **options, plant=((("omega", 2.0),),), ekf=True, csv=Path("errors.csv"))
    assert [row[0] for row in off[1:]] == ["map", "EKF, same model"] * 2
    found = pd.read_csv("errors.csv")
    assert found.columns[:2].tolist() == ["observer", "plant"]
    assert set(found.plant) == {"omega=2 gain=1"}
    assert float(right[1][-2].split()[0]) < 0.1  # starts in X
    assert min(float(row[-2].split()[0]) for row in off[1:]) > 20.0
    _, titles = printed(path, **options, plant_error=1.0)
    assert " ".join(titles).count("plant omega=2 gain=2, model omega=1 gain=1") == 2  # in the titles of both tables


def test_levels_of_each_output(capsys):
    linear_system.exact_observer(0.01, np.eye(2), "two-outputs").save("two.safetensors")
    command = ["evaluate", "two.safetensors", "--system", f"{linear_system.__file__}:TwoOutputs"]
    command += ["--trajectories", "2", "--duration", "2"]
    main([*command, "--measurement-noise", "0", "0.2,0.1", "0.4", "--csv", "errors.csv"])
    assert pd.read_csv("errors.csv").measurement_noise.unique().tolist() == ["0.0", "0.2, 0.1", "0.4"]
    assert "│ X      │ 0.2, 0.1 │" in capsys.readouterr().out
    main(command)
    assert "│ X      │ 0.1, 0.3 │" in capsys.readouterr().out  # the system's own levels
    with pytest.raises(SystemExit, match="one number, or one for each of 2 outputs"):
        main([*command, "--measurement-noise", "1,2,3"])


def test_why_there_are_no_runs():
    linear_system.exact_observer().save("map.safetensors")
    (smape, _), below = printed("map.safetensors", system=f"{__file__}:Cornered", trajectories=10, duration=1.0)
    assert {row[0] for row in smape[1:]} == {"X"}
    assert int(smape[1][-1]) > 0
    assert any("left out: starts in 2X \\ X: no state of oscillator in 2X lies beyond X" in line for line in below)
    unstable = evaluate("map.safetensors", system=f"{__file__}:Unstable", trajectories=5, duration=20.0)
    with pytest.raises(ValueError, match=r"there is nothing to evaluate for map.safetensors"):
        unstable.run(console := Console(record=True))
    text = " ".join(console.export_text().split())
    assert "left out: starts in X: all 5 runs left bounds = ((-30, 30), (-30, 30))" in text
    assert "starts in 2X \\ X: all 5 runs left" in text


def test_a_level_beyond_the_maps_range_is_left_out_and_named(saved):
    path, small = saved(inputs=False), {"trajectories": 2, "duration": 2.0}
    (smape, _), below = printed(path, measurement_noise=(0.0, 1.0, 1.5), **small)
    assert [row[1] for row in smape[1:]] == ["0", "1", "0", "1"]
    assert f"{path}, left out: measurement noise 1.5 is beyond the map's range, 0 to 1" in below
    with pytest.raises(ValueError, match="nothing to evaluate"):
        printed(path, measurement_noise=(1.5,), **small)
    with pytest.raises(ValueError, match="this one has no inputs"):
        printed(path, policy="controller")


def test_t_inv_alone_of_an_observer_that_tracks(saved):
    artifact = tracking_observer()
    artifact.save("map.safetensors")
    options = {"system": f"{linear_system.__file__}:Oscillator", "trajectories": 2, "duration": 5.0}
    tracked, alone = (
        evaluate("map.safetensors", no_tracking=without, **options).run(Console()) for without in (False, True)
    )
    assert set(alone.observer) == {"map.safetensors, T_inv alone"}
    assert not np.allclose(alone.smape, tracked.smape)
    dataclasses.replace(artifact, motion=None).save("map.safetensors")
    same = evaluate("map.safetensors", no_tracking=True, **options).run(Console())
    assert set(same.observer) == {"map.safetensors"}
    np.testing.assert_array_equal(same.smape, alone.smape)


def test_calibration_is_judged(make_artifact, saved):
    system = f"{linear_system.__file__}:Oscillator"
    with_error_bars(make_artifact(system, dt=0.1)).save("map.safetensors")
    options = {"trajectories": 2, "duration": 5.5, "calibration": True, "ekf": True, "csv": Path("coverage.csv")}
    found = evaluate("map.safetensors", system=system, **options).run(console := Console(width=200, record=True))
    assert len(found) == 3 * 6 * 2 * 2  # cases, levels, spans, estimators
    assert found["90"].between(0, 100).all()
    assert set(found.observer) == {"KKL", "EKF"}
    assert Path("coverage.csv").exists()
    assert "NEES" in console.export_text()
    with pytest.raises(ValueError, match="no covariance"):
        evaluate(saved(), calibration=True).run(console)
