"""``kkl-gym evaluate``."""

import dataclasses
import io
from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from training.cli import main
from training.commands.evaluate import Evaluate

TURNING = """
from dataclasses import dataclass

import kkl_gym.elementary as e
from linear_system import Autonomous


@dataclass(frozen=True)
class Turning(Autonomous):
    omega: float = 1.0

    name, dt = "turning", 0.05

    def step(self, x, u):
        c, s = e.cos(self.omega * self.dt), e.sin(self.omega * self.dt)
        return c * x[0] + s * x[1], c * x[1] - s * x[0]
"""
COLUMNS = "observer,starts,driven,process_noise,measurement_noise,trajectory,smape,smape_late"
RESULTS = Path(__file__).parents[3] / "docs" / "results"


def test_every_column_of_the_csv_file_holds_one_thing(saved, tmp_path):
    path, csv = saved(), tmp_path / "new" / "errors.csv"
    main(["evaluate", path, "--trajectories", "2", "--duration", "2", "--measurement-noise", "0", "0.3",
          "--process-noise", "0.1", "--csv", str(csv)])  # fmt: skip
    assert csv.read_text().splitlines()[0] == f"{COLUMNS},nrmse1,nrmse2"
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
def test_every_column_of_the_printed_tables_holds_one_thing(inputs, process_noise, saved):
    (smape, nrmse), _ = printed((saved(inputs=inputs),), process_noise=process_noise, trajectories=2, duration=2.0)
    driven, process = ["driven"] * inputs, ["process noise"] * (process_noise > 0)
    keys = ["starts", *driven, *process, "noise on y"]
    assert smape[0] == [*keys, "all steps", "after transient", "escaped"]
    assert nrmse[0] == [*keys, "x1", "x2"]
    cases = [["X", "no"], ["2X \\ X", "no"], ["X", "yes"]] if inputs else [["X"], ["2X \\ X"]]
    level = ["0.1"] if process_noise else []
    expected = [[*case, *level, noise] for case in cases for noise in ("0", "0.5")]
    assert [row[:-3] for row in smape[1:]] == [row[:-2] for row in nrmse[1:]] == expected


def test_an_exact_kalman_filter_stands_beside_the_observer(saved):
    (smape, nrmse), _ = printed((saved(),), trajectories=2, duration=2.0, ekf=True)
    assert smape[0][:2] == nrmse[0][:2] == ["observer", "starts"]
    assert [row[0] for row in smape[1:]] == [row[0] for row in nrmse[1:]] == [Path(saved()).stem, "exact EKF"] * 6


def test_another_plant_moves_and_nobody_knows(tmp_path):
    """The oscillator turns at rate 1 in the exact observer's model, and twice as fast as a plant."""
    script, path = tmp_path / "turning.py", tmp_path / "map.safetensors"
    script.write_text(TURNING)
    dataclasses.replace(linear_system.exact_observer(name="turning"), parameters={"omega": 1.0}).save(path)
    options = {"system": f"{script}:Turning", "trajectories": 4, "duration": 30.0, "measurement_noise": (0.0,)}
    csv = tmp_path / "errors.csv"
    (right, _), _ = printed((str(path),), **options)
    (off, _), _ = printed((str(path),), **options, plant=(("omega", 2.0),), ekf=True, csv=csv)
    assert [row[0] for row in off[1:]] == ["map", "EKF, same model"] * 2
    found = pd.read_csv(csv)
    assert found.columns[:2].tolist() == ["observer", "plant"]
    assert set(found.plant) == {"omega=2"}
    assert float(right[1][-2].split()[0]) < 0.1  # from X
    assert min(float(row[-2].split()[0]) for row in off[1:]) > 20.0
    Evaluate((str(path),), **options, plant_error=1.0).run(console := Console(record=True, file=io.StringIO()))
    text = " ".join(console.export_text().split())
    assert text.count("plant omega=2, model omega=1") == 2  # in each title
    assert off[1][-3] in text


@pytest.mark.parametrize(("words", "message"), [
    ("lorenz --plant mu=3.3", r"lorenz has no parameter 'mu'; it has sigma, rho, beta"),
    ("van_der_pol lorenz --plant mu=3.3", r"lorenz has no parameter 'mu'"),
    ("lorenz --plant rho=nan", r"parameter rho of lorenz must be a finite number, got nan"),
    ("lorenz --plant rho=1 --plant rho=2", r"--plant names a parameter twice: rho, rho"),
    ("lorenz --plant-error inf", r"must be a finite number, as 0.1 is, got inf"),
    ("lorenz --plant-error 0.1 --plant rho=30", r"give --plant or --plant-error, not both"),
])  # fmt: skip
def test_impossible_plants(words, message):
    with pytest.raises(SystemExit, match=message):
        main(["evaluate", *words.split()])


@pytest.mark.parametrize("words", ["rho", "rho=", "rho=x"])
def test_a_parameter_has_a_name_and_a_value(words, capsys):
    with pytest.raises(SystemExit):
        main(["evaluate", "lorenz", "--plant", words])
    assert f"'{words}' is no parameter with its value: write NAME=VALUE, as in mu=3.3" in capsys.readouterr().err


def printed(observers, **options):
    """What the command prints: its tables, each a header and rows of cells, and the lines below them."""
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


@pytest.fixture(scope="module")
def reactor(tmp_path_factory):
    """An observer in mixed units: 0.03 K off, and 2 % in the concentration."""
    path = tmp_path_factory.mktemp("reactor") / "reactor.safetensors"
    linear_system.reactor_observer(offset=0.03, gain=1.02).save(path)
    return str(path)


def test_nrmse_says_what_smape_of_mixed_units_does_not(reactor):
    options = {"system": f"{linear_system.__file__}:Reactor", "trajectories": 20, "duration": 20.0}
    (smape, nrmse), below = printed((reactor,), measurement_noise=(0.0,), **options)
    assert nrmse[0][2:] == ["T in K", "c in mol/l"]
    assert [row[3].split()[0] for row in smape[1:]] == ["0.01", "0.01"]
    for row in nrmse[1:]:
        assert 0.1 < float(row[2]) < 0.4
        assert 1.5 < float(row[3]) < 2.5
    assert not below


def test_levels_of_each_output(tmp_path, capsys):
    system = f"{linear_system.__file__}:TwoOutputs"
    linear_system.exact_observer(0.01, np.eye(2), "two-outputs").save(tmp_path / "two.safetensors")
    options = [str(tmp_path / "two.safetensors"), "--system", system, "--trajectories", "2", "--duration", "2"]
    main(["evaluate", *options, "--measurement-noise", "0", "0.2,0.1", "0.4", "--csv", str(tmp_path / "errors.csv")])
    assert pd.read_csv(tmp_path / "errors.csv").measurement_noise.unique().tolist() == ["0.0", "0.2, 0.1", "0.4"]
    assert "│ X      │ 0.2, 0.1 │" in capsys.readouterr().out
    main(["evaluate", *options])
    assert "│ X      │ 0.1, 0.3 │" in capsys.readouterr().out  # the system's own
    with pytest.raises(SystemExit, match="one number, or one for each of 2 outputs"):
        main(["evaluate", *options, "--measurement-noise", "1,2,3"])
    with pytest.raises(SystemExit):
        main(["evaluate", *options, "--measurement-noise", "loud"])
    assert "write a number, or one for each output, as in 0.1,0.3" in " ".join(capsys.readouterr().err.split())


def test_durations_and_levels_are_the_systems_own(reactor):
    found = Evaluate((reactor,), f"{linear_system.__file__}:Reactor", trajectories=2).run(
        console := Console(record=True)
    )
    assert "2 runs of 250 s" in console.export_text()  # 5,000 samples, as of the systems that ship
    assert set(found.measurement_noise) == {0.0, 2.0}  # 5 % of 40 K
    assert set(found.columns) == {*COLUMNS.split(","), "nrmse1", "nrmse2"}


CORNERED = """
from linear_system import Oscillator


class Cornered(Oscillator):
    name = "oscillator"
    bounds = ((-1, 1), (-1, 1))


class Driven(Cornered):
    bounds = ((-1.2, 1.2), (-1.2, 1.2))


class Unstable(Oscillator):
    name = "oscillator"

    def f(self, x):
        return 5 * x[0], 5 * x[1]
"""


@pytest.fixture(scope="module")
def cornered(tmp_path_factory):
    """An exact observer of the oscillator, and a script of its variants whose runs leave their bounds."""
    folder = tmp_path_factory.mktemp("cornered")
    linear_system.exact_observer().save(folder / "map.safetensors")
    (folder / "cornered.py").write_text(CORNERED)
    return str(folder / "map.safetensors"), f"{folder / 'cornered.py'}"


def test_why_there_are_no_runs(cornered):
    path, script = cornered
    (smape, _), below = printed((path,), system=f"{script}:Cornered", trajectories=10, duration=1.0)
    assert {row[0] for row in smape[1:]} == {"X"}
    assert int(smape[1][-1]) > 0
    (line,) = below
    assert line.startswith(f"{path}, left out: starts in 2X \\ X: no state of oscillator in 2X lies beyond X")
    with pytest.raises(ValueError, match=r"nothing is left to evaluate of .*map.safetensors"):
        Evaluate((path,), f"{script}:Unstable", trajectories=5, duration=20.0).run(console := Console(record=True))
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
    with pytest.raises(ValueError, match="measurement_noise must be one number, or one for each of 1 outputs"):
        printed((path,), measurement_noise=((0.1, 0.2),), trajectories=2, duration=2.0)


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
