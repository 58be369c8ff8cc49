"""What a run will take."""

from dataclasses import replace

import numpy as np
from linear_system import Oscillator
from small_runs import CPU, toy

import training.dry_run
from training.cli import main
from training.dry_run import estimate
from training.pipeline import Result, train


def test_times_grow_with_batches_and_trajectories(monkeypatch):
    """On runs whose times are known: 2 s for everything else, 0.1 s a batch, 3 s for simulating."""

    def timed(system, config, folder, *, device):
        result = train(system, config, folder, device=device)
        seconds = {stage: 2.0 + 0.1 * loss[-1][0] for stage, loss in result.losses.items()} | {"simulating": 3.0}
        return Result(result.artifact, result.losses, seconds)

    monkeypatch.setattr(training.dry_run, "train", timed)
    monkeypatch.setattr(training.dry_run, "CHUNK", 20)
    monkeypatch.setattr(training.dry_run, "CPU_SECONDS", 0.2)
    config = toy(Oscillator(), "spinn", trajectories=60, duration=20.0, forward_steps=1000, inverse_steps=4000)
    found = estimate(Oscillator(), config, device=CPU)
    assert {name: round(value, 6) for name, value in found.seconds.items()} == {
        "simulating": 9.0,
        "forward": 102.0,
        "inverse": 402.0,
    }
    assert found.pairs == 60 * len(
        np.unique(np.r_[np.geomspace(1, 2000, 20).round(), np.linspace(0, 2000, 20).round()])
    )
    T = (2 * 16 + 16) + (16 * 16 + 16) + (16 * 5 + 5)
    T_inv = (5 + 2) * 16 + 16 + (16 * 16 + 16) + (16 * 2 + 2)
    assert found.parameters == T + T_inv
    assert found.bytes > training.dry_run.PROGRAM


def test_few_batches_and_a_limit_of_time_are_taken_as_they_are(monkeypatch):
    def timed(system, config, folder, *, device):
        result = train(system, config, folder, device=device)
        seconds = {"inverse": 2.0 + 0.1 * result.losses["inverse"][-1][0], "simulating": 3.0}
        return Result(result.artifact, {"inverse": result.losses["inverse"]}, seconds)

    monkeypatch.setattr(training.dry_run, "train", timed)
    monkeypatch.setattr(training.dry_run, "CPU_SECONDS", 0.2)
    config = toy(Oscillator(), inputs=False, cpu_seconds=30.0)
    long = estimate(Oscillator(), replace(config, inverse_steps=4000), device=CPU).seconds
    short = estimate(Oscillator(), replace(config, inverse_steps=3), device=CPU).seconds
    assert long == {"simulating": 3.0, "inverse": 30.0}  # the limit
    assert short == {"simulating": 3.0, "inverse": 2.3}


def test_a_dry_run_says_what_the_papers_sizes_take_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(training.dry_run, "CPU_SECONDS", 0.2)
    sizes = ["--trajectories", "5", "--duration", "12", "--width", "16", "--batch", "64", "--samples", "50"]
    out = ["--out", str(tmp_path / "run")]
    main(["train", "reverse_duffing", "--pipeline", "spinn", "--preset", "paper", "--dry-run", *sizes, *out])
    text = capsys.readouterr().out
    assert "146,484 batches of 64" in text
    assert "5 trajectories of 12 s" in text
    assert not (tmp_path / "run").exists()
