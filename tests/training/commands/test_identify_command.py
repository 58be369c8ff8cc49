"""``kkl-gym identify`` and ``kkl-gym adapt``."""

import json

import numpy as np
import pytest

from kkl_gym.simulate import simulate
from kkl_gym.systems import VanDerPol
from observers import Artifact
from training.cli import main

SIZES = "--trajectories 40 --samples 40 --inverse-steps 40 --width 16 --depth 1 --batch 256".replace(
    "--", "--training."
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Files of outputs of a plant with mu = 3.3."""
    folder, plant = tmp_path_factory.mktemp("data"), VanDerPol(3.3)
    x = simulate(plant, plant.draw_starts(np.random.default_rng(0), 5), 400, plant.dt)
    for i in range(5):
        y = plant.output(x[:, i]) + 0.02 * np.random.default_rng(i).standard_normal((401, 1))
        np.savez(folder / f"{i}.npz", t=plant.dt * np.arange(401), y=y)
    return sorted(map(str, folder.glob("*.npz")))


def test_from_files_to_an_observer(data, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["identify", "van_der_pol", "--data", *data, "--unknown", "mu=2.5:1:5", "--steps", "20", *SIZES.split()])
    folder = tmp_path / "runs" / "van_der_pol-identified"
    found = json.loads((folder / "parameters.json").read_text())["mu"]
    assert abs(found["value"] - 3.3) < 4 * found["standard_error"] < 0.1
    assert Artifact.read(folder / "van_der_pol.safetensors").parameters == {"mu": found["value"]}
    assert f"mu = {found['value']:.6g} +- " in capsys.readouterr().out
    assert {"identification.png", "report.png", "log.txt"} <= {path.name for path in folder.iterdir()}
    again = ["--unknown", "mu=2.5:1:5", "--steps", "20", *SIZES.split(), "--resume"]
    with pytest.raises(SystemExit, match="van_der_pol-identified holds a run of another configuration: records = "):
        main(["identify", "van_der_pol", "--data", *data[:-1], *again])
    main(["adapt", "van_der_pol", "--data", *data, "--out", "new.safetensors", *SIZES.split()])
    assert Artifact.read(tmp_path / "new.safetensors").parameters["mu"] == pytest.approx(found["value"], rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--unknown", "mu"], "NAME=VALUE"),
        (["--unknown", "nu=1"], "no parameter 'nu'"),
        (["--unknown", "mu=0"], "mu=0:LOW:HIGH"),
        (["--unknown", "mu=2:3:4"], "between finite limits"),
        ([], "--unknown mu=1.5"),
        (["--unknown", "mu=2", "--unknown", "mu=3"], "--unknown names a parameter twice: mu, mu"),
        (["--unknown", "mu=2:1:inf"], "between finite limits"),
        (["--unknown", "mu=2", "--steps", "-5"], "steps must be an integer, not negative, got -5"),
        (["--unknown", "mu=2", "--seed", "-1"], "seed = -1"),
        (["--unknown", "mu=2", "--training.width", "-3"], "width = -3"),
    ],
)
def test_what_makes_no_sense(arguments, message, data, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["identify", "van_der_pol", "--data", *data, *arguments])
    said = str(end.value) + capsys.readouterr().err
    assert message in said
    assert said.count("\n") <= 1
