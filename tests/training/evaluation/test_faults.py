"""Sensor faults, on a small scale."""

import dataclasses
from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest

import examples.research.certificates.certificate
import examples.research.certificates.gains
import training.commands.faults
import training.evaluation.faults
import training.teaching.monitor
from kkl_gym import VanDerPol
from kkl_gym.elementary import sin
from observers import Artifact, KKLObserver, Limits
from observers.names import resolve
from training.cli import main
from training.commands.faults import report
from training.evaluation.faults import FAULTS, PARTS, simulate_faults
from training.maps.smooth import decoder


def with_limits(name):
    """A shipped map with limits that nobody calibrated."""
    return dataclasses.replace(
        Artifact.read(resolve(name)),
        limits=Limits(
            np.array([0.0, 1.0]), np.array([[0.3], [0.8]]), np.array([[0.0], [0.2]]), np.array([[0.3], [4.0]]),
            0.5, 5.0, 0.01, 50.0,
        ),
    )  # fmt: skip


@pytest.fixture(scope="module")
def found():
    from kkl_gym import get_system

    told = []
    found = simulate_faults(
        with_limits("lorenz"),
        get_system("lorenz"),
        trajectories=12,
        duration=16.0,
        measurement_noise=0.5,
        seed=0,
        report=told.append,
    )
    assert told == list(range(1, PARTS))
    return found


def test_monitors_and_certificates_tell_the_map_the_process_noise(make_artifact, monkeypatch):
    """It acts in all their runs: limits from an observer told less would not be those of one in an environment."""
    told = []

    class Spy(KKLObserver):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            told.append(self.process_noise)

    def spy(artifact, measurement_noise, process_noise=0.0):
        told.append((measurement_noise, process_noise))
        return decoder(artifact, measurement_noise, process_noise)

    class Noisy(VanDerPol):
        process_noise = 0.12  # not what such an observer takes by default, 0.2

    system = Noisy()
    monkeypatch.setattr(training.teaching.monitor, "KKLObserver", Spy)
    monkeypatch.setattr(training.evaluation.faults, "KKLObserver", Spy)
    artifact = dataclasses.replace(make_artifact(process=True, free_inverse=True), C=np.array([[1.0, 0.0]]))
    calibrated = training.calibrate(artifact, system, duration=6.0, false_alarms=0.5)
    assert set(told) == {0.12}
    told.clear()
    simulate_faults(calibrated, system, trajectories=2, duration=20.0, measurement_noise=0.5, seed=0)
    assert set(told) == {0.12}
    told.clear()
    for module in (examples.research.certificates.certificate, examples.research.certificates.gains):
        monkeypatch.setattr(module, "decoder", spy)
    training.certify(artifact, system, measurement_noise=0.3, trajectories=4)
    assert set(told) == {(0.3, 0.12), (0.0, 0.0)}
    assert told.count((0.3, 0.12)) == 2  # for the errors, and for what noise will do


def test_one_row_for_each_run_and_fault(found):
    assert found.groupby("fault", sort=False).size().to_dict() == dict.fromkeys(FAULTS, 12)
    sound = found[found.fault == "none"]
    assert (sound.score > 0).all()
    assert (sound.score < 1).mean() > 0.8
    for fault in FAULTS[1:]:
        here = found[found.fault == fault]
        assert (here.amplitude.to_numpy() == sound.amplitude.to_numpy()).all()
        assert (here.delay[here.score > 1] <= 2.0).all()
    bias = found[found.fault == "bias"]
    assert (bias.score > 1).all()  # a fifth of Lorenz's range is nine
    assert (bias.delay < 0.5).all()


def test_report_from_the_file_alone(found, tmp_path):
    found.assign(observer="lorenz").to_csv(tmp_path / "faults.csv", index=False)
    report(tmp_path)
    table = (tmp_path / "table.md").read_text()
    assert "| lorenz |" in table
    assert "| bias | 2 s | 100.0 % |" in table
    assert (tmp_path / "scores.png").stat().st_size > 5_000


def test_duffing_is_reported_by_amplitude(tmp_path):
    rows = [
        ("mine", "reverse_duffing", fault, 10.0, i, float(i), 2.0 if i > 4 else 0.5, 1.0)
        for fault in FAULTS
        for i in range(9)
    ]
    columns = ["observer", "system", "fault", "deadline", "trajectory", "amplitude", "score", "delay"]
    pd.DataFrame(rows, columns=columns).to_csv(tmp_path / "faults.csv", index=False)
    report(tmp_path)
    table = (tmp_path / "table.md").read_text()
    assert "mine by amplitude" in table
    assert "| bias | 0 % | 0 % | 100 % | 100 % |" in table


def test_command(tmp_path, monkeypatch, capsys):
    artifact = with_limits("lorenz")
    monkeypatch.setattr(Artifact, "read", lambda path: artifact)
    main(["faults", "lorenz", "--runs", "4", "--duration", "12", "--out", str(tmp_path)])
    assert "noticed" in capsys.readouterr().out
    found = pd.read_csv(tmp_path / "faults.csv")
    assert found.groupby(["observer", "system"]).size().to_dict() == {("lorenz", "lorenz"): 16}
    assert set(found.deadline) == {2.0}
    for wrong in (["pendulum"], ["--trajectories", "1"], ["lorenz", "lorenz"]):
        with pytest.raises(SystemExit, match="kkl-gym: "):
            main(["faults", *wrong, "--out", str(tmp_path)])


def test_the_level_and_the_duration_are_the_systems_own(make_artifact, tmp_path, monkeypatch):
    told = []

    def spy(artifact, system, *, duration, measurement_noise, **_):
        told.append((duration, measurement_noise))
        return pd.DataFrame({"score": [0.0], "fault": "none", "deadline": 1.0, "delay": 0.0, "system": system.name})

    monkeypatch.setattr(training.evaluation.faults, "simulate_faults", spy)
    monkeypatch.setattr(training.commands.faults, "report", lambda out: "")
    for system in ("van_der_pol", "Oscillator", "Slow"):
        name = f"{tmp_path / 'systems.py'}:{system}"
        (tmp_path / "systems.py").write_text(
            "from linear_system import Oscillator\n\n\nclass Slow(Oscillator):\n    name, dt = 'slow', 0.1\n"
        )
        own = system != "van_der_pol"
        make_artifact(system=name if own else system).save(tmp_path / "map.safetensors")
        path = str(tmp_path / "map.safetensors")
        main(["faults", path, *(["--system", name] if own else []), "--out", str(tmp_path / "out")])
    assert told == [(50.0, 0.5), (50.0, 0.1), (500.0, 0.1)]


def test_an_observer_in_a_file_for_a_system_of_ones_own(make_artifact, tmp_path, capsys):
    system = f"{linear_system.__file__}:Oscillator"
    limits = Limits(
        np.array([0.0, 1.0]), np.full((2, 1), 0.5), np.zeros((2, 1)), np.full((2, 1), 2.0), 0.5, 5.0, 0.01, 50.0
    )
    path = str(tmp_path / "mine.safetensors")
    dataclasses.replace(make_artifact(system=system), C=np.array([[1.0, 0.0]]), limits=limits).save(path)
    with pytest.raises(SystemExit, match="name its class with --system"):
        main(["faults", path])
    options = ["--system", system, "--trajectories", "4", "--duration", "12", "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit, match=f"nothing is left of {path}"):
        main(["faults", path, "--noise", "1.5", *options])
    assert f"{path}, left out: measurement noise 1.5 is beyond the map's range, 0 to 1" in capsys.readouterr().out
    main(["faults", path, *options])
    found = pd.read_csv(tmp_path / "out" / "faults.csv")
    assert found.groupby(["observer", "system", "fault"]).size().to_dict() == {
        (path, "oscillator", fault): 4 for fault in FAULTS
    }
    assert set(found.deadline) == {2.4}  # a fifth of the duration
    assert (tmp_path / "out" / "scores.png").stat().st_size > 5_000


def test_published_faults_have_the_columns_that_the_command_writes(found, tmp_path):
    published = Path(__file__).parents[3] / "docs" / "results" / "faults"
    faults = pd.read_csv(published / "faults.csv")
    assert list(faults.columns) == ["observer", *found.columns]
    faults.to_csv(tmp_path / "faults.csv", index=False)
    report(tmp_path)
    assert (tmp_path / "table.md").read_text() == (published / "table.md").read_text()


def test_faults_of_an_output_that_is_not_linear():
    class Sine(linear_system.Oscillator):
        name = "oscillator"
        X = ((-0.2, 0.2), (-0.2, 0.2))
        process_noise = 0.0

        def h(self, x):
            return (sin(x[0]),)

    blind = dataclasses.replace(linear_system.exact_observer(), C=None, measurement_noise=0.01)
    calibrated = training.teaching.monitor.calibrate(blind, Sine(), duration=10.0, false_alarms=0.1)
    rows = simulate_faults(calibrated, Sine(), trajectories=10, duration=20.0, measurement_noise=0.01, seed=0)
    alarms = rows.assign(alarm=rows.delay < np.inf).groupby("fault").alarm.mean()
    assert alarms["none"] <= 0.2
    assert (alarms[["bias", "drop-out", "freeze"]] >= 0.8).all()
