"""``kkl-gym observability``."""

import linear_system
import numpy as np
import pandas as pd
import pytest
from recorded_runs import as_csv, swing

from training.cli import main


@pytest.fixture(autouse=True)
def _wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")


def test_an_environment(capsys, tmp_path):
    words = "observability Pendulum-v1 --measured 0,1 --hidden 2 --steps 2000 --measurement-noise 0.05,0.1 --out ."
    main(words.split())
    shown = capsys.readouterr().out
    assert "what follows from obs[0], obs[1] and action[0]" in shown
    row = next(line for line in shown.splitlines() if "obs[2]" in line)
    assert "determined" in row
    assert "0.05 s)" in row
    assert "noise 0.05, 0.1" in shown
    assert (tmp_path / "observability.png").stat().st_size > 10_000
    written = pd.read_csv("observability.csv", dtype={"measurement_noise": str})
    assert list(written) == ["signal", "measurement_noise", "steps", "seconds", "error", "linear", "change"]
    assert set(written.measurement_noise) == {"0.0", "0.05, 0.1"}
    np.testing.assert_allclose(written.seconds, 0.05 * written.steps)
    exact = written[written.measurement_noise == "0.0"].set_index("steps")
    assert exact.error[0] > 0.9 > 0.05 > exact.error[8]
    assert written[written.steps == 8].error.is_monotonic_increasing


def test_recorded_data(capsys):
    files = [as_csv(f"{i}.csv", swing(i, n=200)) for i in range(6)]
    options = ["--measured", "position", "--inputs", "force", "--hidden", "speed", "--measurement-noise", "0.5"]
    main(["observability", "--data", *files, *options])
    shown = capsys.readouterr().out
    assert "0.csv and 5 more" in shown
    assert "what follows from position and force" in " ".join(shown.split())
    assert "determined" in next(line for line in shown.splitlines() if "│ speed" in line)


def test_a_system(capsys):
    main(["observability", f"{linear_system.__file__}:Oscillator", "--dt", "0.05", "--duration", "10"])
    shown = capsys.readouterr().out
    rows = [line for line in shown.splitlines() if "│ x" in line]
    assert "y alone" in rows[0]
    assert "determined" in rows[1]
    assert "equations, noise" in shown
