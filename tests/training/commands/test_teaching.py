"""``kkl-gym errorbars`` and ``kkl-gym tracking`` write what was learned into a file of its own."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from error_bars import with_error_bars
from recorded_runs import as_csv, swing

from observers import Artifact
from training.cli import main


def test_a_map_with_error_bars_is_written(make_artifact, capsys):
    artifact = make_artifact("van_der_pol", dt=0.02, age=True, process=True)
    training = {"pipeline": "input-aware", "eigenvalues": [-1.0], "dt": 0.02, "duration": 2.0, "batch": 64}
    dataclasses.replace(artifact, training=training).save("map.safetensors")
    main(["errorbars", "map.safetensors", "--steps", "2", "--trajectories", "100"])
    assert "wrote runs/errorbars/map.safetensors" in capsys.readouterr().out
    written = Artifact.read("runs/errorbars/map.safetensors")
    assert written.inverse.spread.factors.shape[0] == 2
    for mine, other in zip(written.inverse.mlp.weights, artifact.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(mine, other.astype(np.float32))
    with pytest.raises(SystemExit, match=r"is the map that is taught, which would be lost: name another file"):
        main(["errorbars", "map.safetensors", "--out", "map.safetensors"])


def test_a_map_that_tracks_is_written_and_what_it_gains_can_be_asked_for(make_artifact, capsys, monkeypatch):
    with_error_bars(make_artifact()).save("map.safetensors")
    asked = {}
    monkeypatch.setattr(
        "training.teaching.tracking.learn_tracking", lambda artifact, system, **how: asked.update(how) or artifact
    )
    main(["tracking", "map.safetensors", "--size", "small", "--steps", "3", "--trajectories", "50", "--seed", "7"])
    assert {"small": True, "steps": 3, "trajectories": 50, "seed": 7, "policy": None}.items() <= asked.items()
    shown = capsys.readouterr().out
    assert "kkl-gym evaluate map.safetensors runs/tracking/map.safetensors says what it gains" in shown
    assert Path("runs/tracking/map.safetensors").exists()


@pytest.mark.parametrize("command", ["errorbars", "tracking"])
def test_an_observer_from_records_takes_records(command, make_artifact, monkeypatch):
    signals = {"measured": ["position"], "inputs": ["force"], "hidden": ["speed", "position"]}
    dataclasses.replace(make_artifact(), signals=signals).save("map.safetensors")
    given = []
    work = {"errorbars": "errorbars.learn_recorded_error_bars", "tracking": "tracking.learn_recorded_tracking"}
    monkeypatch.setattr(
        f"training.recorded.{work[command]}", lambda artifact, records, **_: given.extend(records) or artifact
    )
    main([command, "map.safetensors", "--data", as_csv("spring.csv", swing(0, n=200))])
    assert given[0].signals.hidden == ("speed", "position")
    for wrong, message in (
        ([], "was learned from recorded states, and nothing can be simulated"),
        (["--trajectories", "200", "--data", "spring.csv"], "--trajectories: of no use for the observer"),
    ):
        with pytest.raises(SystemExit, match=message):
            main([command, "map.safetensors", *wrong])
