"""Sensor faults, on a small scale."""

import dataclasses
from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest

import training.evaluation.faults
from kkl_gym import VanDerPol
from kkl_gym.elementary import sin
from observers import KKLObserver, Limits
from training import files
from training.cli import main
from training.commands.faults import HEADER, fault_rows
from training.evaluation.faults import FAULTS, simulate_faults
from training.presets import preset
from training.trajectories.equations import output_facts

COLUMNS = "observer,system,fault,deadline,trajectory,score,delay"
LIMITS = Limits(
    np.array([0.0, 1.0]), np.full((2, 1), 0.5), np.zeros((2, 1)), np.full((2, 1), 2.0), 0.5, 5.0, 0.01, 50.0
)
OSCILLATOR = f"{linear_system.__file__}:Oscillator"


def test_monitors_are_given_the_process_noise_of_the_runs(make_artifact, monkeypatch):
    levels = []

    class Spy(KKLObserver):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            levels.append(self.process_noise)

    class Noisy(VanDerPol):
        process_noise = 0.12  # not what such an observer takes by default, 0.2

    monkeypatch.setattr(training.evaluation.faults, "KKLObserver", Spy)
    artifact = dataclasses.replace(make_artifact(process=True), C=np.array([[1.0, 0.0]]), limits=LIMITS)
    simulate_faults(artifact, Noisy(), trajectories=2, duration=20.0, measurement_noise=0.5, seed=0)
    assert levels == [0.12]


def test_the_command_and_its_report(tmp_path, capsys):
    path = str(tmp_path / "faults.csv")
    main(["evaluate", "lorenz", "--faults", "--trajectories", "12", "--duration", "16", "--csv", path])
    assert "noticed" in capsys.readouterr().out
    found = pd.read_csv(path)
    assert ",".join(found) == COLUMNS
    assert found.groupby("fault", sort=False).size().to_dict() == dict.fromkeys(FAULTS, 12)
    assert set(found.observer) == set(found.system) == {"lorenz"}
    assert set(found.deadline) == {2.0}
    sound, bias = found[found.fault == "none"], found[found.fault == "bias"]
    assert (sound.score > 0).all()
    assert (sound.score < 1).mean() > 0.8
    assert (bias.score > 1).all()  # a fifth of Lorenz's range is nine
    assert (bias.delay < 0.5).all()
    for fault in FAULTS[1:]:
        here = found[found.fault == fault]
        assert (here.delay[here.score > 1] <= 2.0).all()
    assert [row[0] for row in fault_rows(found)] == 3 * ["lorenz"]
    assert fault_rows(found)[0][2:5] == ["bias", "2 s", "100.0 %"]


def test_the_table_on_the_page_is_that_of_the_file():
    results = Path(__file__).parents[3] / "docs" / "results"
    published = pd.read_csv(results / "faults" / "faults.csv")
    assert ",".join(published) == COLUMNS
    assert "\n".join(files.table(["", *HEADER], fault_rows(published))) in (results / "faults.md").read_text()


def test_an_observer_in_a_file_for_a_system_of_ones_own(make_artifact, tmp_path, capsys):
    path = str(tmp_path / "mine.safetensors")
    dataclasses.replace(make_artifact(system=OSCILLATOR), C=np.array([[1.0, 0.0]]), limits=LIMITS).save(path)
    with pytest.raises(SystemExit, match="name its class with --system"):
        main(["evaluate", path, "--faults"])
    csv = str(tmp_path / "faults.csv")
    options = ["--faults", "--system", OSCILLATOR, "--trajectories", "4", "--duration", "12", "--csv", csv]
    with pytest.raises(SystemExit, match=f"nothing is left to evaluate of {path}"):
        main(["evaluate", path, "--measurement-noise", "1.5", *options])
    assert f"{path}, left out: measurement noise 1.5 is beyond the map's range, 0 to 1" in capsys.readouterr().out
    main(["evaluate", path, *options])
    found = pd.read_csv(csv)
    assert found.groupby(["observer", "system"]).size().to_dict() == {(path, "oscillator"): 16}
    assert set(found.deadline) == {2.4}  # a fifth of the duration


def test_faults_of_an_output_that_is_not_linear():
    class Sine(linear_system.Oscillator):
        name = "oscillator"
        X = ((-0.2, 0.2), (-0.2, 0.2))
        process_noise = 0.0

        def h(self, x):
            return (sin(x[0]),)

    h = output_facts(Sine())["h"]
    exact = dataclasses.replace(linear_system.exact_observer(), C=None, h=h, measurement_noise=0.01)
    config = preset(Sine(), changes={"dt": 0.05, "runs": 100, "inputs": False})
    calibrated = training.calibrate(exact, training.SimulatedSource(Sine(), config), false_alarms=0.1)
    rows = simulate_faults(calibrated, Sine(), trajectories=10, duration=20.0, measurement_noise=0.01, seed=0)
    alarms = rows.assign(alarm=rows.delay < np.inf).groupby("fault").alarm.mean()
    assert alarms["none"] <= 0.2
    assert (alarms[["bias", "drop-out", "freeze"]] >= 0.8).all()
