"""The optimisation loop."""

import numpy as np
import pytest
import torch

import training.evaluation.errors
import training.maps.optimise
import training.pipeline
import training.trajectories.record
from observers.storage import UNFINISHED
from training import checkpoints
from training.progress import progress_bars


class Clock:
    """CPU time that goes on by a hundredth of a second whenever somebody looks."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        self.now += 0.01
        return self.now


def test_a_cap_ends_a_stage_and_counts_what_was_spent_before(tmp_path, monkeypatch):
    monkeypatch.setattr(training.maps.optimise.time, "process_time", Clock())
    rates = []

    class Line(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.a = torch.nn.Parameter(torch.zeros(1))

    def fit(stop_after=None):
        module, calls = Line(), []

        def loss(generator):
            calls.append(float(module.a.detach()))
            if stop_after and len(calls) > stop_after:
                raise KeyboardInterrupt
            return {"loss": ((module.a - 1.0) ** 2).sum()}

        stage = training.maps.optimise.Stage(
            name="line",
            steps=10**9,
            learning_rate=0.1,
            folder=tmp_path,
            fingerprint="same",
            seed=0,
            cpu_seconds=4.0,
        )
        with progress_bars(None) as progress:
            training.maps.optimise.optimise(stage, module, loss, progress, resume=True)
        rates.extend(np.abs(np.diff(calls)))
        return len(calls)

    monkeypatch.setattr(checkpoints, "SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        fit(stop_after=150)  # the checkpoint is of step 100
    spent = training.maps.optimise.seconds_spent(tmp_path)
    assert 1.5 < spent < 3.0
    rest = fit()
    assert 4.0 <= training.maps.optimise.seconds_spent(tmp_path) < 4.1
    assert rest == pytest.approx(100 * (4.0 - spent) / spent, rel=0.1)
    assert rates[-1] < 1e-4  # the learning rate has followed the clock to zero
    assert fit() == 0
    (tmp_path / f"{UNFINISHED}1234-line{checkpoints.SUFFIX}").write_bytes(b"half")  # of a process that was killed
    assert 4.0 <= training.maps.optimise.seconds_spent(tmp_path) < 4.1
    (tmp_path / f"other{checkpoints.SUFFIX}").write_bytes(b"half")
    with pytest.raises(ValueError, match="is damaged or of an older version, remove it"):
        training.maps.optimise.seconds_spent(tmp_path)
