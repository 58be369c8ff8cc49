"""``kkl-gym errorbars`` and ``kkl-gym evaluate --calibration``."""

import numpy as np
import pytest
from error_bars import with_error_bars
from rich.console import Console

from observers import Artifact
from training.commands.errorbars import ErrorBars
from training.commands.evaluate import Evaluate


@pytest.fixture
def console():
    return Console(width=200, record=True)


def test_a_map_with_error_bars_is_written(tmp_path, console, make_artifact):
    source, out = tmp_path / "map.safetensors", tmp_path / "bars.safetensors"
    artifact = make_artifact("van_der_pol", dt=0.02, age=True, process=True)
    training = {"pipeline": "input-aware", "eigenvalues": [-1.0], "dt": 0.02, "duration": 2.0, "batch": 64}
    object.__setattr__(artifact, "training", training)
    artifact.save(source)
    found = ErrorBars(str(source), steps=2, trajectories=100, out=out).run(console)
    assert "wrote" in console.export_text()
    written = Artifact.read(out)
    np.testing.assert_array_equal(written.inverse.spread.factors, found.inverse.spread.factors)
    assert written.inverse.spread.factors.shape[0] == 2
    for mine, other in zip(written.inverse.mlp.weights, artifact.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(mine, other.astype(np.float32))
    with pytest.raises(ValueError, match=r"must end in \.safetensors"):
        ErrorBars(str(source), out=tmp_path / "bars").run(console)


def test_calibration_is_judged(tmp_path, console, make_artifact):
    path = tmp_path / "map.safetensors"
    with_error_bars(make_artifact("van_der_pol", dt=0.1)).save(path)
    csv = tmp_path / "coverage.csv"
    found = Evaluate((str(path),), trajectories=2, duration=5.5, calibration=True, ekf=True, csv=csv).run(console)
    assert len(found) == 3 * 6 * 2 * 2  # cases, levels, spans, and both who estimate
    assert found["90"].between(0, 100).all()
    assert set(found.observer) == {"KKL", "EKF"}
    assert csv.exists()
    assert csv.with_suffix(".png").exists()
    assert "NEES" in console.export_text()
    bare = tmp_path / "bare.safetensors"
    make_artifact("van_der_pol").save(bare)
    with pytest.raises(ValueError, match="no error bars"):
        Evaluate((str(bare),), calibration=True).run(console)
