"""``python -m examples.research speed`` and ``sizes`` with tiny steps."""

import json

import pandas as pd
import pytest
from rich.console import Console

from examples.research.speed.sizes import Sizes
from examples.research.speed.speed import Speed
from examples.research.speed.torch_steps import TorchSpeed

TINY = {"steps": 5, "turns": 1, "num_envs": 4, "vector_steps": 3}


@pytest.mark.parametrize(
    ("observer", "wrapped", "observers"),
    [
        ("van_der_pol-large", ["x_hat", "x_hat, error bars"], 1),
        pytest.param(None, ["x_hat", "x_hat, error bars", "x_hat, large"], 2, marks=pytest.mark.research),
    ],
)
def test_speed_of_a_shipped_system(observer, wrapped, observers, capsys):
    ratios = Speed("van_der_pol", observer, **TINY).run(Console(width=200))
    single = {"KKLVanDerPol-v0", *(f"KKLVanDerPol-v0, {what}" for what in wrapped)}
    batched = {f"{name}, 4 rows" for name in (*single, "KKLVanDerPol-v0, z", "CartPole-v1")}
    assert set(ratios) == {"Pendulum-v1", *single, *batched}
    assert (ratios["Pendulum-v1"], ratios["CartPole-v1, 4 rows"]) == (1.0, 1.0)
    lines = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if "│" in line]
    rows = [sum(len(cells) == columns for cells in lines) for columns in (3, 5, 6)]
    assert rows == [3 + len(wrapped), 3 + len(wrapped), 6 * observers]
    with pytest.raises(ValueError, match="turns must be positive"):
        Speed(turns=0).run(Console())


def test_the_table_of_torch_has_a_row_for_each_observer_and_the_memory(capsys):
    lines = TorchSpeed(rows=(128,), turns=1).run(Console(width=200))
    assert [(line[0], line[1], len(line)) for line in lines] == [
        (name, "128", 5) for name in ("reverse_duffing", "van_der_pol", "rossler", "lorenz", "memory")
    ]
    assert min(float(each) for line in lines for each in line[2:] if each != "–") > 0
    assert capsys.readouterr().out.count("| lorenz | 128 |") == 1
    with pytest.raises(ValueError, match="rows positive, got 3 and"):
        TorchSpeed(rows=(0,)).run(Console())


def test_sizes_trains_each_width_once(tmp_path):
    settings = {"trajectories": 20, "duration": 5.0, "samples": 20, "inverse_steps": 5, "batch": 64, "runs": 100}
    (tmp_path / "tiny.json").write_text(json.dumps(settings))
    how = {"config": tmp_path / "tiny.json", "trajectories": 2, "num_envs": 4, "out": tmp_path / "out"}
    frame = Sizes("van_der_pol", widths=(4,), **how).run(Console(quiet=True))
    assert list(frame.width) == [4]
    assert (frame[["smape_without_noise", "smape_under_noise", "us_single", "us_a_row"]] > 0).all(axis=None)
    written = pd.read_csv(tmp_path / "out" / "sizes.csv")
    assert list(written.columns) == list(frame.columns)
    assert (tmp_path / "out" / "sizes.png").stat().st_size > 1000
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "4").glob("*.checkpoint*")}
    again = Sizes("van_der_pol", widths=(4,), **how).run(Console(quiet=True))
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert before
    assert again.smape_under_noise[0] == frame.smape_under_noise[0]
    with pytest.raises(ValueError, match="widths must be positive and differ"):
        Sizes("lorenz", widths=(8, 8)).run(Console())
