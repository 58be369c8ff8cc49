"""``kkl-gym observability``."""

from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest
from recorded_runs import as_csv, swing

from training.cli import main

OSCILLATOR = f"{Path(linear_system.__file__)}:Oscillator"


@pytest.fixture(autouse=True)
def _wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")


def test_an_environment(capsys, tmp_path):
    words = "observability Pendulum-v1 --measured 0,1 --hidden 2 --steps 2000 --measurement-noise 0.05,0.1"
    main([*words.split(), "--out", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "what follows from obs[0], obs[1] and action[0]" in shown
    row = next(line for line in shown.splitlines() if "obs[2]" in line)
    assert "determined" in row
    assert "step" in row
    assert "0.05 s)" in row
    assert "noise 0.05, 0.1" in shown
    assert (tmp_path / "observability.png").stat().st_size > 10_000
    written = pd.read_csv(tmp_path / "observability.csv", dtype={"measurement_noise": str})
    assert list(written) == ["signal", "measurement_noise", "steps", "seconds", "error", "linear", "change"]
    assert set(written.measurement_noise) == {"0.0", "0.05, 0.1"}
    np.testing.assert_allclose(written.seconds, 0.05 * written.steps)
    exact = written[written.measurement_noise == "0.0"].set_index("steps")
    assert exact.error[0] > 0.9 > 0.05 > exact.error[8]
    assert written[written.steps == 8].error.is_monotonic_increasing


def test_recorded_data(capsys, tmp_path):
    files = [as_csv(tmp_path / f"{i}.csv", swing(i, n=200)) for i in range(6)]
    options = ["--measured", "position", "--inputs", "force", "--hidden", "speed", "--measurement-noise", "0.5"]
    main(["observability", "--data", *files, *options])
    shown = capsys.readouterr().out
    assert "0.csv and 5 more" in shown
    assert "what follows from position and force" in " ".join(shown.split())
    assert "determined" in next(line for line in shown.splitlines() if "│ speed" in line)


def test_a_system(capsys):
    main(["observability", OSCILLATOR, "--duration", "10"])
    shown = capsys.readouterr().out
    rows = [line for line in shown.splitlines() if "│ x" in line]
    assert "y alone" in rows[0]
    assert "determined" in rows[1]
    assert "equations, noise" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "name an environment .*a system, or recorded data"),
        ("Pendulum-v1", "unknown system 'Pendulum-v1'.*of an environment, say what is --measured and --hidden"),
        ("Pendulum-v1 --measured 0,1", "which signals are hidden"),
        ("Pendulum-v1 --hidden 2", "which entries of the observation are measured"),
        ("Pendulum-v1 --measured 0,1 --hidden 2 --dt 0.1", "--dt: of no use for an environment, but for a system"),
        ("Pendulum-v1 --measured 0 --hidden 2 --inputs a", "--inputs: of no use for an environment"),
        ("lorenz --steps 3 --env-kwargs g=1", "--steps, --env-kwargs: of no use for a system, but for an environment"),
        ("lorenz --data runs.csv", "NAME .* has no place beside --data; got lorenz"),
        ("--data runs.csv --policy random", "--policy: of no use for recorded data"),
        ("lorenz --dt -1", "dt = -1"),
        ("lorenz --measurement-noise nan", "measurement_noise must"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(SystemExit, match=message):
        main(["observability", *arguments.split()])
