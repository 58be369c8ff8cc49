"""The optimisation loop."""

import numpy as np
import pytest
import torch

import training.run
from examples.research.benchmark.jobs import seconds_spent
from observers.storage import UNFINISHED
from training.progress import progress_bars


def line_of(folder, **settings):
    return training.run.Stage(**{"name": "line", "folder": folder, "fingerprint": "same", "seed": 0, **settings})


class Clock:
    """A CPU clock that advances by 20 ms per call."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        self.now += 0.02
        return self.now


def test_a_time_limit_ends_a_stage_and_includes_time_before_resuming(tmp_path, monkeypatch):
    monkeypatch.setattr(training.run.time, "process_time", Clock())
    rates = []

    def fit(stop_after=None):
        module, calls = torch.nn.Linear(1, 1, bias=False), []
        torch.nn.init.zeros_(module.weight)

        def loss(generator):
            calls.append(module.weight.item())
            if stop_after and len(calls) > stop_after:
                raise KeyboardInterrupt
            return {"loss": ((module.weight - 1.0) ** 2).sum()}

        stage = line_of(tmp_path, steps=10**9, learning_rate=0.1, cpu_seconds=4.0)
        with progress_bars(None) as progress:
            training.run.optimise(stage, module, loss, progress, resume=True)
        rates.extend(np.abs(np.diff(calls)))
        return len(calls)

    monkeypatch.setattr(training.run, "CHECKPOINT_SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        fit(stop_after=150)  # the last checkpoint is at step 100
    spent = seconds_spent(tmp_path)
    assert 1.5 < spent < 3.0
    rest = fit()
    assert 4.0 <= seconds_spent(tmp_path) < 4.1
    assert rest == pytest.approx(100 * (4.0 - spent) / spent, rel=0.1)
    assert rates[-1] < 1e-4  # the schedule follows the clock to zero
    assert fit() == 0
    (tmp_path / f"{UNFINISHED}1234-line{training.run.CHECKPOINT}").write_bytes(b"half")  # left by a killed process
    assert 4.0 <= seconds_spent(tmp_path) < 4.1
    (tmp_path / f"other{training.run.CHECKPOINT}").write_bytes(b"half")
    with pytest.raises(ValueError, match="is damaged or of another version; remove it"):
        seconds_spent(tmp_path)


@pytest.mark.parametrize("optimiser", ["adam", "soap"])
def test_batches_in_place_are_those_of_a_plain_loop(optimiser, tmp_path):
    def fresh():
        torch.manual_seed(0)
        return torch.nn.Linear(3, 1)

    def loss_of(module):
        def loss(generator):
            x = torch.randn(64, 3, generator=generator)
            return {"loss": (module(x) - x.sum(-1, keepdim=True)).square().mean()}

        return loss

    stage = line_of(tmp_path, steps=40, learning_rate=0.05, seed=3, optimiser=optimiser)
    module, plain = fresh(), fresh()
    with progress_bars(None) as progress:
        history = training.run.optimise(stage, module, loss_of(module), progress, resume=False)
    generator, loss, total = torch.Generator().manual_seed(3), loss_of(plain), 0.0
    steps = training.run._optimiser(stage, plain)
    for step in range(40):
        rate = min(1.0, (step / 40 + 1 / 40) / training.run.WARM_UP) * 0.5 * (1 + np.cos(np.pi * step / 40))
        steps.param_groups[0]["lr"] = 0.05 * rate
        value = loss(generator)["loss"]
        steps.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(plain.parameters(), 1.0)
        steps.step()
        total += float(value.detach())
    assert torch.equal(module.weight, plain.weight)
    assert history == [(40, pytest.approx(total / 40))]
