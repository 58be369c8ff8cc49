import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


def example(name):
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]


def test_estimate(capsys):
    assert example("estimate")(seconds=5.0) < 0.1
    assert "x_hat" in capsys.readouterr().out


def test_own_system(tmp_path):
    assert example("own_system")(inverse_steps=500, trajectories=100, out=tmp_path) < 20.0


def test_own_system_from_the_command_line(tmp_path, capsys):
    from training.cli import main

    system = f"{EXAMPLES / 'own_system.py'}:Pendulum"
    sizes = "--trajectories 20 --duration 5 --samples 30 --width 16 --depth 1 --batch 128 --inverse-steps 50"
    main(["train", system, *sizes.split(), "--threads", "1", "--no-monitor", "--out", str(tmp_path)])
    path = str(tmp_path / "pendulum.safetensors")
    main(["evaluate", path, "--system", system, "--trajectories", "3", "--duration", "8"])
    assert "2X" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="--system"):
        main(["evaluate", path])


def test_sb3_agent():
    reward = example("sb3_agent")(num_envs=2, steps=256)
    assert example("sb3_agent")(num_envs=2, steps=256) == reward  # everything random is seeded
    assert example("sb3_agent")(num_envs=2, steps=256, seed=1) != reward
