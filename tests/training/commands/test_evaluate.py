"""``kkl-gym evaluate``."""

import dataclasses
import io
from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest
from error_bars import with_error_bars
from rich.console import Console

from training.cli import main
from training.commands.evaluate import Evaluate

SCRIPT = """
from dataclasses import dataclass

import kkl_gym.elementary as e
from linear_system import Autonomous, Oscillator


@dataclass(frozen=True)
class Turning(Autonomous):
    omega: float = 1.0

    name, dt = "turning", 0.05

    def step(self, x, u):
        c, s = e.cos(self.omega * self.dt), e.sin(self.omega * self.dt)
        return c * x[0] + s * x[1], c * x[1] - s * x[0]


class Cornered(Oscillator):
    name = "oscillator"
    bounds = ((-1, 1), (-1, 1))


class Unstable(Oscillator):
    name = "oscillator"

    def f(self, x):
        return 5 * x[0], 5 * x[1]
"""
COLUMNS = "observer,starts,driven,process_noise,measurement_noise,trajectory,smape,smape_late"
RESULTS = Path(__file__).parents[3] / "docs" / "results"


@pytest.fixture(autouse=True)
def _systems(tmp_path):
    (tmp_path / "own.py").write_text(SCRIPT)


def printed(observers, **options):
    """The tables of the command, each a header and rows of cells, and the lines below them."""
    console = Console(width=200, record=True, file=io.StringIO())
    Evaluate(observers, **options).run(console)
    tables, below = [], []
    for line in console.export_text().splitlines():
        if line.startswith("┏"):
            tables.append(([], []))
        elif line.startswith("┃"):
            tables[-1][0].append(line.split("┃")[1:-1])
        elif line.startswith("│"):
            tables[-1][1].append([cell.strip() for cell in line.split("│")[1:-1]])
        elif ", left out: " in line:
            below.append(line)
    joined = [[" ".join(" ".join(lines).split()) for lines in zip(*names, strict=True)] for names, _ in tables]
    return [[header, *rows] for header, (_, rows) in zip(joined, tables, strict=True)], below


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


@pytest.mark.parametrize(("inputs", "process_noise"), [(False, 0.0), (True, 0.1)])
def test_every_column_of_the_printed_tables_holds_one_thing(inputs, process_noise, saved):
    (smape, nrmse), _ = printed((saved(inputs=inputs),), process_noise=process_noise, trajectories=2, duration=2.0)
    keys = ["starts", *["driven"] * inputs, *["process noise"] * (process_noise > 0), "noise on y"]
    assert smape[0] == [*keys, "all steps", "after transient", "escaped"]
    assert nrmse[0] == [*keys, "x1", "x2"]
    cases = [["X", "no"], ["2X \\ X", "no"], ["X", "yes"]] if inputs else [["X"], ["2X \\ X"]]
    level = ["0.1"] if process_noise else []
    expected = [[*case, *level, noise] for case in cases for noise in ("0", "0.5")]
    assert [row[:-3] for row in smape[1:]] == [row[:-2] for row in nrmse[1:]] == expected


def test_an_exact_kalman_filter_stands_beside_the_observer(saved):
    (smape, nrmse), _ = printed((saved(),), trajectories=2, duration=1.0, ekf=True)
    assert smape[0][:2] == nrmse[0][:2] == ["observer", "starts"]
    assert [row[0] for row in smape[1:]] == [row[0] for row in nrmse[1:]] == [Path(saved()).stem, "exact EKF"] * 6


def test_another_plant_moves_and_nothing_knows():
    """The oscillator turns at rate 1 in the exact observer's model, and twice as fast as a plant."""
    dataclasses.replace(linear_system.exact_observer(name="turning"), parameters={"omega": 1.0}).save("map.safetensors")
    options = {"system": "own.py:Turning", "trajectories": 4, "duration": 30.0, "measurement_noise": (0.0,)}
    (right, _), _ = printed(("map.safetensors",), **options)
    (off, _), _ = printed(("map.safetensors",), **options, plant=(("omega", 2.0),), ekf=True, csv=Path("errors.csv"))
    assert [row[0] for row in off[1:]] == ["map", "EKF, same model"] * 2
    found = pd.read_csv("errors.csv")
    assert found.columns[:2].tolist() == ["observer", "plant"]
    assert set(found.plant) == {"omega=2"}
    assert float(right[1][-2].split()[0]) < 0.1  # from X
    assert min(float(row[-2].split()[0]) for row in off[1:]) > 20.0
    Evaluate(("map.safetensors",), **options, plant_error=1.0).run(console := Console(record=True, file=io.StringIO()))
    text = " ".join(console.export_text().split())
    assert text.count("plant omega=2, model omega=1") == 2  # in each title
    assert off[1][-3] in text


def test_mixed_units_and_the_systems_own_duration_and_level():
    """An observer that is 0.03 K off, and 2 % in the concentration; 5,000 samples, and 5 % of 40 K."""
    linear_system.reactor_observer(offset=0.03, gain=1.02).save("reactor.safetensors")
    options = {"system": f"{linear_system.__file__}:Reactor", "trajectories": 20}
    (smape, nrmse), below = printed(("reactor.safetensors",), measurement_noise=(0.0,), duration=20.0, **options)
    assert nrmse[0][2:] == ["T in K", "c in mol/l"]
    assert [row[3].split()[0] for row in smape[1:]] == ["0.01", "0.01"]
    for row in nrmse[1:]:
        assert 0.1 < float(row[2]) < 0.4
        assert 1.5 < float(row[3]) < 2.5
    assert not below
    found = Evaluate(("reactor.safetensors",), **options | {"trajectories": 1}).run(console := Console(record=True))
    assert "1 runs of 250 s" in console.export_text()
    assert set(found.measurement_noise) == {0.0, 2.0}


def test_levels_of_each_output(capsys):
    linear_system.exact_observer(0.01, np.eye(2), "two-outputs").save("two.safetensors")
    command = ["evaluate", "two.safetensors", "--system", f"{linear_system.__file__}:TwoOutputs"]
    command += ["--trajectories", "2", "--duration", "2"]
    main([*command, "--measurement-noise", "0", "0.2,0.1", "0.4", "--csv", "errors.csv"])
    assert pd.read_csv("errors.csv").measurement_noise.unique().tolist() == ["0.0", "0.2, 0.1", "0.4"]
    assert "│ X      │ 0.2, 0.1 │" in capsys.readouterr().out
    main(command)
    assert "│ X      │ 0.1, 0.3 │" in capsys.readouterr().out  # the system's own
    with pytest.raises(SystemExit, match="one number, or one for each of 2 outputs"):
        main([*command, "--measurement-noise", "1,2,3"])
    with pytest.raises(SystemExit):
        main([*command, "--measurement-noise", "loud"])
    assert "write a number, or one for each output, as in 0.1,0.3" in " ".join(capsys.readouterr().err.split())


def test_why_there_are_no_runs():
    linear_system.exact_observer().save("map.safetensors")
    (smape, _), (line,) = printed(("map.safetensors",), system="own.py:Cornered", trajectories=10, duration=1.0)
    assert {row[0] for row in smape[1:]} == {"X"}
    assert int(smape[1][-1]) > 0
    assert line.startswith("map.safetensors, left out: starts in 2X \\ X: no state of oscillator in 2X lies beyond X")
    with pytest.raises(ValueError, match=r"nothing is left to evaluate of map.safetensors"):
        Evaluate(("map.safetensors",), "own.py:Unstable", trajectories=5, duration=20.0).run(
            console := Console(record=True)
        )
    text = " ".join(console.export_text().split())
    assert "left out: starts in X: each of 5 runs left bounds = ((-30, 30), (-30, 30))" in text
    assert "starts in 2X \\ X: each of 5 runs left" in text


def test_a_level_beyond_the_maps_range_is_left_out_and_named(saved):
    path = saved(inputs=False)
    (smape, _), (line,) = printed((path,), measurement_noise=(0.0, 1.0, 1.5), trajectories=2, duration=2.0)
    assert [row[1] for row in smape[1:]] == ["0", "1", "0", "1"]
    assert line == f"{path}, left out: measurement noise 1.5 is beyond the map's range, 0 to 1"
    with pytest.raises(ValueError, match="nothing is left"):
        printed((path,), measurement_noise=(1.5,), trajectories=2, duration=2.0)
    with pytest.raises(ValueError, match="this one takes none"):
        printed((path,), policy="controller")


def test_calibration_is_judged(make_artifact, saved):
    system = f"{linear_system.__file__}:Oscillator"
    with_error_bars(make_artifact(system, dt=0.1)).save("map.safetensors")
    options = {
        "system": system,
        "trajectories": 2,
        "duration": 5.5,
        "calibration": True,
        "ekf": True,
        "csv": Path("coverage.csv"),
    }
    console = Console(width=200, record=True)
    found = Evaluate(("map.safetensors",), **options, csv=Path("coverage.csv")).run(console)
    assert len(found) == 3 * 6 * 2 * 2  # cases, levels, spans, and both who estimate
    assert found["90"].between(0, 100).all()
    assert set(found.observer) == {"KKL", "EKF"}
    assert Path("coverage.csv").exists()
    assert Path("coverage.png").exists()
    assert "NEES" in console.export_text()
    with pytest.raises(ValueError, match="no error bars"):
        Evaluate((saved(),), calibration=True).run(console)


@pytest.mark.parametrize(("name", "process_noise"), [("accuracy", 0.0), ("accuracy-process-noise", 0.05)])
def test_published_errors_have_the_same_columns(name, process_noise):
    path = RESULTS / f"{name}.csv"
    assert path.read_text().splitlines()[0] == f"{COLUMNS},nrmse1,nrmse2,nrmse3"
    found = pd.read_csv(path)
    assert set(found.starts) == {"X", "2X \\ X"}
    assert set(found.process_noise) == {process_noise}
    assert set(found.measurement_noise) == {0.0, 0.5}
    assert found.driven.dtype == bool
    assert (found.groupby(["observer", "starts", "driven", "measurement_noise"]).size() >= 97).all()


def test_the_page_says_what_the_published_errors_on_other_plants_are():
    systems = [f"{name}-static" for name in ("reverse_duffing", "van_der_pol", "rossler", "lorenz")]
    found = pd.read_csv(RESULTS / "plant-error.csv")
    assert found.columns[:2].tolist() == ["observer", "plant"]
    medians = found.groupby(["starts", "driven", "observer", "measurement_noise"])[["smape", "smape_late"]].median()
    page = (RESULTS / "benchmark.md").read_text()
    for starts, driven, title, column in (
        ("X", False, "starts in X, all steps", "smape"), ("X", False, "starts in X, after 20 %", "smape_late"),
        ("2X \\ X", False, "starts in 2X \\ X, all steps", "smape"),
        ("X", True, "starts in X, driven, after 5 s", "smape_late"),
    ):  # fmt: skip
        cells = [
            " / ".join(f"{medians.loc[(starts, driven, system, level), column]:#.3g}" for level in (0.0, 0.5))
            for system in systems
        ]
        assert f"| {title} | {' | '.join(cells)} |" in page
