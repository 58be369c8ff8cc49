"""``kkl-gym identify``; test_refusals.py has its errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
from random_artifacts import random_artifact

from kkl_gym.simulate import simulate
from kkl_gym.systems import VanDerPol
from observers import Artifact
from training.cli import main

SIZES = "--set trajectories=20 duration=5 samples=20 inverse_steps=20 width=8 depth=1 batch=64"


def test_identify_from_files_and_adapt_an_observer(tmp_path, capsys):
    """The files hold outputs of a plant with mu = 3.3."""
    plant, data = VanDerPol(3.3), [f"{i}.npz" for i in range(4)]
    x = simulate(plant, plant.draw_starts(np.random.default_rng(0), 4), 200, 0.02)
    for i, path in enumerate(data):
        y = plant.output(x[:, i]) + 0.02 * np.random.default_rng(i).standard_normal((201, 1))
        np.savez(path, t=0.02 * np.arange(201), y=y)
    options = ["--unknown", "mu=2.5:1:5", *SIZES.split()]
    main(["identify", "van_der_pol", "--data", *data, *options])
    folder = tmp_path / "runs" / "van_der_pol-identified"
    found = json.loads((folder / "parameters.json").read_text())["mu"]
    assert abs(found["value"] - 3.3) < 4 * found["standard_error"] < 0.1
    assert Artifact.read(folder / "van_der_pol.safetensors").parameters == {"mu": found["value"]}
    assert f"mu = {found['value']:.6g} +- " in capsys.readouterr().out
    assert {"identification.png", "report.png", "log.txt"} <= {path.name for path in folder.iterdir()}
    with pytest.raises(SystemExit, match="van_der_pol-identified holds a run of another configuration: records = "):
        main(["identify", "van_der_pol", "--data", *data[:-1], *options, "--resume"])
    main(["identify", "VanDerPol", "--observer", "van_der_pol", "--data", *data, *SIZES.split()])
    adapted = Artifact.read("runs/van_der_pol-adapted/van_der_pol.safetensors")
    assert adapted.parameters["mu"] == pytest.approx(found["value"], rel=1e-3)


def test_an_observer_of_a_bias_is_not_adapted():
    artifact, plant = random_artifact(system="lorenz"), VanDerPol()
    training = artifact.training | {"pipeline": "input-aware", "eigenvalues": [-1.0], "bias": 1.0}
    replace(artifact, system=plant.name, parameters=plant.parameters, training=training).save("biased.safetensors")
    np.savez("y.npz", t=0.01 * np.arange(301), y=np.sin(0.01 * np.arange(301)))
    with pytest.raises(SystemExit, match=r"but identification does not"):
        main(["identify", "van_der_pol", "--observer", "biased.safetensors", "--data", "y.npz"])
