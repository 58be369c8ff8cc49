"""The optimisation loop."""

import errno
import re
import threading

import numpy as np
import pytest
import torch
import torch.utils.tensorboard

import training.evaluation.errors
import training.maps.optimise
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
    with pytest.raises(ValueError, match="is damaged or of another version, remove it"):
        training.maps.optimise.seconds_spent(tmp_path)


class FullDisk:
    """A writer of TensorBoard's whose thread and whose caller both meet a full disk."""

    def __init__(self, folder):
        pass

    def __enter__(self):
        for error in (OSError(errno.ENOSPC, "No space left on device"), ValueError("of something else")):
            thread = threading.Thread(target=self.fail, args=(error,))
            thread.start()
            thread.join()
        self.fail(OSError(errno.ENOSPC, "No space left on device"))

    def __exit__(self, *arguments):
        pass

    def fail(self, error):
        raise error


def test_a_disk_that_is_full_of_scalars_is_told_once(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(threading, "excepthook", seen.append)
    hook = threading.excepthook
    monkeypatch.setattr(torch.utils.tensorboard, "SummaryWriter", FullDisk)
    with (
        pytest.raises(OSError, match=re.escape(f"No space left on device: '{tmp_path}'")),
        training.maps.optimise.log_to(tmp_path),
    ):
        raise AssertionError
    (failed,) = seen
    assert str(failed.exc_value) == "of something else"
    assert threading.excepthook == hook
