"""``python -m examples.research speed`` and ``torch`` with tiny steps."""

import pytest
from rich.console import Console

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
    single = {"Pendulum-v1", "Pendulum-v1, memory"}
    single |= {"KKLVanDerPol-v0", *(f"KKLVanDerPol-v0, {what}" for what in wrapped)}
    batched = {f"KKLVanDerPol-v0{what}, 4 rows" for what in ("", ", z", *(f", {each}" for each in wrapped))}
    assert set(ratios) == {*single, *batched, "CartPole-v1, 4 rows", "CartPole-v1, 4 rows, memory"}
    assert (ratios["Pendulum-v1"], ratios["CartPole-v1, 4 rows"]) == (1.0, 1.0)
    lines = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if "│" in line]
    names = [cells[0].strip() for cells in lines]
    assert {*single, *batched} < {*names}
    of_tables = ("KKL", "KKL, NumPy", "KKL, error bars", "KKL, error bars, NumPy", "EKF", "EKF of filterpy")
    own = [name.removeprefix("van_der_pol").removeprefix("-large").removeprefix(", ") for name in names]
    assert {what: own.count(what) for what in of_tables} == {
        what: observers + (what == "KKL") for what in of_tables
    }  # one more row measures records
    assert {len(cells) for cells in lines} == {3}
    with pytest.raises(ValueError, match="turns must be positive"):
        Speed(turns=0).run(Console())


def test_the_table_of_torch_has_a_row_for_each_observer_and_the_memory(capsys):
    lines = TorchSpeed(rows=(128,), turns=1).run(Console(width=200))
    assert [(line[0], line[1], len(line)) for line in lines] == [
        (name, "128", 5) for name in ("reverse_duffing", "van_der_pol", "rossler", "lorenz", "memory")
    ]
    assert min(float(each) for line in lines for each in line[2:] if each != "–") > 0
    assert capsys.readouterr().out.count("| lorenz | 128 |") == 1
    with pytest.raises(ValueError, match="turns and rows must be positive, got 3 and"):
        TorchSpeed(rows=(0,)).run(Console())
