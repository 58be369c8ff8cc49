"""Options that make no sense are refused in one line that names them, before any work is done."""

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
    rows = Path("spring.csv").read_text().splitlines()
    for name, row, changed in (("cells", 5, "1,2,3"), ("time", 9, "0.1,0,0,0"), ("number", 4, "0.15,much,0,0")):
        Path(f"{name}.csv").write_text("\n".join([*rows[:row], changed, *rows[row + 1 :]]))
    Path("list.json").write_text("[1]")
    Path("binary.json").write_bytes(b"\xff")
    Path("broken.toml").write_text("width: 3")
    Path("policy.json").write_text('{"policy": "evil.py:act"}')


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (f"diagnose {OSCILLATOR} --dt -1", "dt must"),
        (f"diagnose {OSCILLATOR} --parameters rho=1", "no parameter 'rho'"),
        ("diagnose", "name a system, an environment .*, or recorded data"),
        ("diagnose Pendulum-v1", "unknown system 'Pendulum-v1'.*; an environment needs --measured and --hidden"),
        (
            "diagnose Pendulum-v1 --measured 0,1 --hidden 2 --dt 0.1",
            "--dt: of no use for an environment, but for",
        ),
        ("diagnose lorenz --steps 3 --env-kwargs g=1", "--steps, --env-kwargs: of no use for a system, but for an env"),
        (
            "diagnose lorenz --csv errors.csv",
            "--csv: of no use for a system, but for an environment or rec",
        ),
        ("diagnose lorenz --data runs.csv", "NAME .* has no place beside --data; got lorenz"),
        ("train nonsense", "unknown system 'nonsense'"),
        ("train Lorentz", "unknown system 'Lorentz', did you mean 'lorenz'"),
        ("train lorenz --set wdith=3", "--set: unknown setting 'wdith', did you mean 'width'"),
        ("train lorenz --set width=3 width=4", "--set names width twice"),
        ("train lorenz --set width=3.5", "--set: width = 3.5: Input should be a valid integer"),
        ("train lorenz --config broken.toml", "broken.toml is no TOML"),
        ("train", r"name a system, or recorded data \(--data\)"),
        ("train lorenz --parameters rh=30", "no parameter 'rh'"),
        ("train lorenz --out /dev/null/x", "/dev/null/x.*: Not a directory"),
        ("train lorenz --uncertain rho=0.1 --uncertain rho=0.2", "--uncertain names rho twice"),
        (f"{RECORDED} --measured angle", r"spring.csv: no column angle; .*\(--measured\)"),
        ("train spring --data spring.csv --measured position", "no hidden states were recorded"),
        (f"{RECORDED} --data nowhere.csv", "there is no file nowhere.csv"),
        (f"{RECORDED} --size large --set runs=200", "--size: of no use with --data"),
        (f"{RECORDED} --set bias=1", "bias: of no use with --data"),
        ("train lorenz --set bias=[]", r"bias = \(\) must be a number that is not negative, or one of each output"),
        ("train lorenz --set bias=[1,2]", r"bias must be one number, or one of each of 1 outputs, got \(1.0, 2.0\)"),
        (f"{RECORDED} --set runs=200", "runs: of no use with --data"),
        ("train lorenz --set windows=100", r"windows needs recorded data \(--data\)"),
        ("train lorenz --size large --pipeline spinn", "--size large is of the pipeline 'input-aware', not 'spinn'"),
        (RECORDED.replace("spring.csv", "cells.csv"), "cells.csv: row 5 has 3 cells, the header 4"),
        (RECORDED.replace("spring.csv", "time.csv"), "time.csv: column time, row 9: time must increase"),
        (RECORDED.replace("spring.csv", "number.csv"), "number.csv: column position, row 4: 'much' is no number"),
        ("train lorenz --set forward_steps=5", "pipeline 'input-aware' does not go with forward_steps = 5"),
        ("train lorenz --set transients=false", "transients = False: settings of the pipeline"),
        ("train lorenz --config list.json", "list.json must hold settings by name, got a list"),
        ("train lorenz --config binary.json", "binary.json is no JSON"),
        ("train lorenz --config policy.json", "policy.json: unknown setting 'policy'"),
        (RECORDED.replace("spring", "../spring", 1), "SYSTEM is a name of your choice"),
        (f"{IDENTIFY} --unknown mu", "NAME=VALUE"),
        (f"{IDENTIFY} --unknown mu=0", "mu=0:LOW:HIGH"),
        (IDENTIFY, "--unknown mu=1.5"),
        (f"{IDENTIFY} --observer van_der_pol --parameters mu=2", "--parameters: of no use with --observer"),
        ("evaluate", "name an observer; shipped: "),
        ("evaluate lorenz --csv .", "csv = . is a folder: name a file"),
        ("evaluate lorenz --measurement-noise", "at least one level"),
        ("evaluate van_der_pol lorenz --plant mu=3.3", "lorenz has no parameter 'mu'; it has sigma, rho, beta"),
        ("evaluate lorenz --plant-error 0.1 --plant rho=30", "give --plant or --plant-error, not both"),
        ("evaluate lorenz --plant rho=x", "'rho=x' is no parameter with its value: write NAME=VALUE, as in mu=3.3"),
        ("agent train lorenz --threads 0", "threads must be at least 1"),
        ("agent train lorenz --information y --observer lorenz", "no use for the observer"),
        (f"agent train {OSCILLATOR}", r"no observer ships for 'oscillator': name a \.safetensors file"),
        ("agent evaluate lorenz --seed -1", "seed must not be negative"),
        ("evaluate pendulum --faults", "unknown observer 'pendulum'"),
        ("evaluate lorenz lorenz --faults", "name each observer once, got lorenz, lorenz"),
        ("evaluate lorenz --faults --ekf", "--ekf: of no use with --faults"),
        ("evaluate lorenz --faults --measurement-noise 0 1", "--faults takes one level of measurement noise, got 2"),
        ("evaluate lorenz --faults --duration 0.1", "within which it is to be noticed"),
        ("export lorenz --format onnx --measurement-noise 0.1", "levels of noise are inputs of an ONNX graph"),
        ("export lorenz --format c --measurement-noise 5", "beyond the map's range, 0 to 3.0"),
        ("demo --duration nan", "duration must be finite"),
        ("demo --observer lorenz", "name the system that the observer lorenz is for"),
        ("demo lorenz --observer rossler", "the observer was made for the system 'rossler'"),
        (f"demo {OSCILLATOR}", "no observer ships for 'oscillator': name a file, --observer FILE"),
    ],
)
def test_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments.split())
    said = f"{end.value}\n" if end.value.code != 2 else capsys.readouterr().err
    assert said.startswith("kkl-gym: ")
    assert said.count("\n") == 1
    assert re.search(message, said), said


@pytest.mark.parametrize(
    "arguments",
    [
        "evaluate lorenz --csv file/errors.csv",
        "demo --out file",
        "diagnose lorenz --json file/found.json",
    ],
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
