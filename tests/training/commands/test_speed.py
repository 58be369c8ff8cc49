"""kkl-gym speed."""

from rich.console import Console

from training.commands.speed import Speed


def test_speed_measures_every_environment(capsys):
    ratios = Speed(steps=20, turns=1, num_envs=8, vector_steps=5).run(Console(width=200))
    assert len(ratios) == 9 + 13
    printed = capsys.readouterr().out
    assert "simulation" in printed
    assert "KKLLorenz-v0, z" in printed
    assert all(ratio > 0 for ratio in ratios.values())
