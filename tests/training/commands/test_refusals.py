"""Invalid options give a message of one line that names them, before any work."""

import re
from pathlib import Path

import linear_system
import numpy as np
import pytest
from recorded_runs import as_csv, swing

from training.cli import main
from training.files import locked
from training.progress import ProgressBars

OSCILLATOR = f"{linear_system.__file__}:Oscillator"
RECORDED = "train spring --data spring.csv --measured position --inputs force --hidden speed"
IDENTIFY = "identify van_der_pol --data y.npz"


@pytest.fixture(autouse=True)
def _records():
    as_csv("spring.csv", swing(0, n=200))
    t = 0.01 * np.arange(500)
    np.savez("y.npz", t=t, y=np.sin(t))
    Path("binary.json").write_bytes(b"\xff")
    Path("broken.toml").write_text("width: 3")
    Path("policy.json").write_text('{"policy": "evil.py:act"}')


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("diagnose", "name a system, an environment .*, or recorded data"),
        ("diagnose Pendulum-v1", "unknown system 'Pendulum-v1'.*; an environment needs --measured and --hidden"),
        ("diagnose Pendulum-v1 --measured 0,1 --hidden 2 --dt 0.1", "--dt: of no use for an environment, only for"),
        ("diagnose lorenz --steps 3 --env-kwargs g=1", "--steps, --env-kwargs: of no use for a system, only for an e"),
        ("train Lorentz", "unknown system 'Lorentz', did you mean 'lorenz'"),
        ("train lorenz --set wdith=3", "--set: unknown setting 'wdith', did you mean 'width'"),
        ("train lorenz --set width=3 width=4", "--set names width twice"),
        ("train lorenz --config broken.toml", "broken.toml is not valid TOML"),
        ("train", r"name a system, or recorded data \(--data\)"),
        (f"{RECORDED} --measured angle", r"spring.csv: no column angle; .*\(--measured\)"),
        ("train spring --data spring.csv --measured position", "no hidden states were recorded"),
        (f"{RECORDED} --data nowhere.csv", "there is no file nowhere.csv"),
        (f"{RECORDED} --set bias=1", "bias: of no use with --data"),
        ("train lorenz --set windows=100", r"windows needs recorded data \(--data\)"),
        ("train lorenz --size large --pipeline spinn", "--size large needs the pipeline 'input-aware', not 'spinn'"),
        ("train lorenz --config binary.json", "binary.json is not valid JSON"),
        ("train lorenz --config policy.json", "policy.json: unknown setting 'policy'"),
        (RECORDED.replace("spring", "../spring", 1), "SYSTEM is a name of your choice"),
        (f"{IDENTIFY} --unknown mu", "NAME=VALUE"),
        (IDENTIFY, "--unknown mu=1.5"),
        (f"{IDENTIFY} --observer van_der_pol --parameters mu=2", "--parameters: of no use with --observer"),
        ("evaluate", "name an observer; shipped: "),
        ("evaluate lorenz --csv .", "csv = . is a folder: name a file"),
        ("evaluate lorenz --measurement-noise", "at least one level"),
        ("evaluate lorenz --plant-error 0.1 --plant rho=30", "give --plant or --plant-error, not both"),
        ("agent train lorenz --threads 0", "threads must be at least 1"),
        (f"agent train {OSCILLATOR}", r"no observer ships for 'oscillator': pass a \.safetensors file"),
        ("agent evaluate lorenz --seed -1", "seed must be at least 0"),
        ("evaluate pendulum --faults", "unknown observer 'pendulum'"),
        ("evaluate lorenz lorenz --faults", "name each observer once, got lorenz, lorenz"),
        ("evaluate lorenz --faults --limit", "--limit: of no use with --faults"),
        ("evaluate script.py:Class", "script.py:Class names a system; pass its observer's file, such as runs/"),
        ("export lorenz --format pdf", "'pdf' is not a format: write onnx or c"),
        ("train lorenz --policy controler", "unknown policy 'controler', did you mean 'controller'"),
        ("evaluate lorenz --faults --measurement-noise 0 1", "--faults takes one level of measurement noise, got 2"),
        ("evaluate lorenz --faults --duration 0.1", "duration must be at least 4 s to simulate faults, got 0.1"),
        ("export lorenz --format onnx --measurement-noise 0.1", "noise levels are inputs of an ONNX graph"),
        ("demo --duration nan", "duration must be finite"),
        ("demo --observer lorenz", "name the system of the observer lorenz as well"),
        ("demo lorenz --observer rossler", "the observer was made for the system 'rossler'"),
    ],
)
def test_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments.split())
    printed = f"{end.value}\n" if end.value.code != 2 else capsys.readouterr().err
    assert printed.startswith("kkl-gym: ")
    assert printed.count("\n") == 1
    assert re.search(message, printed), printed


@pytest.mark.parametrize(
    "arguments", ["evaluate lorenz --csv file/errors.csv", "demo --out file", "diagnose lorenz --json file/found.json"]
)
def test_a_place_that_cannot_be_written_to_is_refused_before_long_work(arguments, tmp_path, monkeypatch):
    def work(self, description, **options):
        raise AssertionError(f"{description} has begun")

    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setattr(ProgressBars, "add_task", work)
    with pytest.raises(SystemExit, match=r"file.*: Not a directory"):
        main(arguments.split())


def test_two_agents_do_not_share_a_folder(tmp_path):
    with locked(tmp_path), pytest.raises(SystemExit, match="another process is at work"):
        main(["agent", "train", "lorenz", "--timesteps", "1", "--out", str(tmp_path)])
