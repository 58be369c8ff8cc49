"""The optimisation loop."""

import numpy as np
import pytest
import torch
from small_runs import BATCHES, CPU, open_loop
from torch._subclasses.fake_tensor import FakeTensorMode

import training.run
from examples.research.benchmark.jobs import seconds_spent
from kkl_gym import VanDerPol, get_system
from observers.storage import UNFINISHED
from training import checkpoints
from training.config import Config
from training.maps.forward import ForwardProblem
from training.maps.inverse import ForwardMapSampler, InverseProblem
from training.maps.networks import Network
from training.progress import progress_bars
from training.spectrum import Spectrum


def forward_problem(system, device=CPU):
    """An untrained T, with pairs that are none."""
    rng, linear = np.random.default_rng(0), Spectrum((-1.0, -2.0)).filter(system.ny, 0.01)
    x = rng.uniform(*system.box(), (200, system.nx))
    torch.manual_seed(0)
    config = Config("spinn", (-1.0,), forward_steps=1, width=8, depth=2, activation="silu", batch=64)
    pairs = x, rng.normal(size=(200, linear.size))
    return ForwardProblem(system, linear, config, pairs=pairs, points=x, device=device)


def line_of(folder, **settings):
    return training.run.Stage(**{"name": "line", "folder": folder, "fingerprint": "same", "seed": 0, **settings})


class Clock:
    """CPU time that goes on by a hundredth of a second at each look."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        self.now += 0.01
        return self.now


def test_a_cap_ends_a_stage_and_counts_what_was_spent_before(tmp_path, monkeypatch):
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

    monkeypatch.setattr(checkpoints, "SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        fit(stop_after=150)  # the checkpoint is of step 100
    spent = seconds_spent(tmp_path)
    assert 1.5 < spent < 3.0
    rest = fit()
    assert 4.0 <= seconds_spent(tmp_path) < 4.1
    assert rest == pytest.approx(100 * (4.0 - spent) / spent, rel=0.1)
    assert rates[-1] < 1e-4  # the learning rate has followed the clock to zero
    assert fit() == 0
    (tmp_path / f"{UNFINISHED}1234-line{checkpoints.SUFFIX}").write_bytes(b"half")  # of a process that was killed
    assert 4.0 <= seconds_spent(tmp_path) < 4.1
    (tmp_path / f"other{checkpoints.SUFFIX}").write_bytes(b"half")
    with pytest.raises(ValueError, match="is damaged or of another version, remove it"):
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


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol", "rossler", "lorenz"])
def test_risks_of_t_are_one_graph_for_the_compiler(name):
    problem = forward_problem(get_system(name))
    batch = problem._x[:64], problem._z[:64], problem._points[:64]
    whole = torch.compile(problem.risk, fullgraph=True, backend="eager")
    torch.testing.assert_close(whole(*batch), problem.risk(*batch))


def test_losses_ask_tensors_for_no_numbers_and_have_one_shape():
    """Fake tensors have no values: to read one, or to make a shape of them, raises."""
    sampler, *_ = open_loop(0.5)
    points = np.random.default_rng(0).normal(size=(100, 2))
    paper = ForwardMapSampler(lambda x: np.tile(x, 2), np.eye(4), BATCHES, points=points, device=CPU)
    problems = [forward_problem(VanDerPol())]
    for each in (sampler, paper):
        inputs = each(torch.Generator())[0].shape[1]
        problems.append(InverseProblem(Network(inputs, 2, width=8, depth=1, activation="tanh"), each, CPU))
    for problem in problems:
        assert problem.capturable
        with FakeTensorMode(allow_non_fake_inputs=True):
            problem.loss(torch.Generator())["loss"].backward()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("optimiser", ["adam", "soap"])
def test_a_captured_stage_on_a_gpu_is_the_same_as_an_eager_one(optimiser, tmp_path, monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function: function)
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda precision: None)
    weights = []
    for captured in (True, False):
        monkeypatch.setattr(ForwardProblem, "capturable", captured)
        problem = forward_problem(VanDerPol(), torch.device("cuda"))
        stage = line_of(tmp_path, name=f"T{captured}", steps=50, learning_rate=1e-3, optimiser=optimiser)
        with progress_bars(None) as progress:
            training.run.optimise(stage, problem, problem.loss, progress, resume=False)
        weights.append(problem.network.linear_layers()[0].weight.detach().cpu())
    torch.testing.assert_close(*weights, rtol=1e-3, atol=1e-4)
