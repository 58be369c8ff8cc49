"""The methods of the benchmark: each method trains and estimates, and agrees with closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from linear_system import Oscillator

from examples.research.methods import ABLATION, METHODS, Budget, Task, get_method
from examples.research.methods.node import rollout
from examples.research.methods.sequences import GRUCell, LRUCell, Model, SequenceObserver, TransformerCell
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from observers import LinearFilter
from observers.estimator import Running
from training.trajectories.motions import filter_states


def run(estimator, y):
    """Estimates along outputs (steps, n, ny)."""
    return Running(estimator).along(y)


SMALL = Budget("small", 100, 25.0, samples=60, cpu_seconds=math.inf, width=32, depth=2, dt=0.05)
TINY = replace(SMALL, trajectories=10, samples=20, width=8, depth=1, dt=0.02, steps=2)


def trained_on_oscillator(name, tmp_path, configuration=0, **changes):
    method, system = get_method(name), Oscillator()
    budget = replace(SMALL, **changes)
    trained = method.train(Task(system, budget, tmp_path), method.configurations(system)[configuration])
    return method, system, trained, budget.dt


def oscillations(dt, seconds=30.0, n=8, seed=0):
    system = Oscillator()
    x0 = np.random.default_rng(seed).uniform(*system.box(), (n, 2))
    return simulate(system, x0, round(seconds / dt), dt)


LATER = [pytest.param(name, marks=pytest.mark.research) for name in ABLATION if name not in METHODS]


@pytest.mark.parametrize("name", [*METHODS, "ablation-transients", *LATER])
def test_each_method_trains_and_its_file_observes(name, tmp_path):
    method, system = get_method(name), Oscillator()
    assert 1 <= len(method.configurations(system)) <= 3
    trained = method.train(Task(system, TINY, tmp_path / "train"), method.configurations(system)[-1])
    path = tmp_path / "trained.safetensors"
    method.save(trained, path)
    y = system.output(oscillations(0.02, 1.0, n=3))
    before, after = (run(method.observer(one, system, 0.02, 0.1), y) for one in (trained, method.load(path)))
    assert before.shape == (51, 3, 2)
    assert np.isfinite(before).all()
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-9)


@pytest.mark.research
@pytest.mark.parametrize(
    ("name", "steps", "trajectories"),
    [("default", 1500, 1000), ("node", 600, 100), ("gru", 150, 100), ("lru", 150, 100), ("transformer", 80, 100)],
)
def test_each_learned_method_learns(name, steps, trajectories, tmp_path):
    method, system, trained, dt = trained_on_oscillator(name, tmp_path, steps=steps, trajectories=trajectories)
    x = oscillations(dt)
    late = (run(method.observer(trained, system, dt, 0.0), system.output(x)) - x)[len(x) // 2 :]
    assert np.sqrt((late**2).mean() / (x**2).mean()) < 0.2


def test_transients_of_the_observer_of_node_decay_at_the_learned_rate(tmp_path):
    method, system, artifact, dt = trained_on_oscillator("node", tmp_path, configuration=1, steps=100)
    slowest = -artifact.filter.A.diagonal().max()
    assert slowest != pytest.approx(1.0, abs=1e-4)  # the initial rate
    y = system.output(oscillations(dt))
    misled = y.copy()
    misled[0] += 1e-3
    difference = [run(method.observer(artifact, system, dt, 0.0), one) for one in (misled, y)]
    k = np.arange(round(4.0 / dt), round(12.0 / dt))
    sizes = np.linalg.norm((difference[0] - difference[1])[k], axis=-1).mean(-1)
    assert -np.polyfit(k * dt, np.log(sizes), 1)[0] == pytest.approx(slowest, rel=0.1)


@pytest.mark.parametrize("ny", [1, 2])
def test_rollout_is_the_filter_sample_by_sample(ny):
    rng = np.random.default_rng(0)
    A = -np.diag(rng.uniform(0.5, 5.0, 4)) + np.triu(rng.normal(size=(4, 4)), 1)
    linear = LinearFilter(A, rng.normal(size=(4, ny)), 0.05)
    y = rng.normal(size=(301, 3, ny))
    ages = np.array([0, 1, 2, 7, 8, 150, 300])
    expected = filter_states(linear, y, np.zeros((300, 3, 0)), ages)
    parts = (torch.as_tensor(part) for part in (linear.transition, linear.early_y, linear.late_y))
    states = rollout(*parts, z0=torch.as_tensor(expected[0]), y=torch.as_tensor(y.swapaxes(0, 1)), ages=ages)
    np.testing.assert_allclose(states.numpy(), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_kalman_filters_get_the_noise_level(name):
    method, system = get_method(name), get_system("van_der_pol")
    trained, y0 = {"diffusion": np.array([0.01])}, np.array([[3.0]])
    first = [run(method.observer(trained, system, 0.01, noise), y0[None])[0, 0, 0] for noise in (0.0, 50.0)]
    assert first[0] == pytest.approx(3.0, abs=0.01)  # starting from the centre of X, 0
    assert first[1] == pytest.approx(3.0 * (25 / 3) / (25 / 3 + 2500), rel=1e-6)


@pytest.mark.parametrize("cell", [GRUCell, LRUCell, TransformerCell])
def test_a_sequence_model_agrees_with_its_observer_sample_by_sample(cell):
    """Sequences longer than the transformer's window, in two chunks; rows are independent; a sample is missing."""
    torch.manual_seed(0)
    model, noise = Model(cell, 8, 1, 2), torch.tensor([0.3])
    y = torch.randn(250, 3, 1)
    y[40, 1] = np.nan
    with torch.no_grad():
        first, state = model(y[:70], noise, model.cell.start(3))
        second, _ = model(y[70:], noise, state)
    x_hat = run(SequenceObserver(model, noise), y.numpy())
    np.testing.assert_allclose(x_hat, torch.cat([first, second]), atol=1e-5)
    alone = run(SequenceObserver(model, noise), y[:, 2:].numpy())
    np.testing.assert_allclose(x_hat[:, 2:], alone, atol=1e-5)
    assert np.isfinite(x_hat).all()


def test_methods_and_files_that_are_no_methods(tmp_path):
    script, path = tmp_path / "mine.py", tmp_path / "one.safetensors"
    script.write_text("from examples.research.methods import Method\n\n\nclass Mine(Method):\n    name = 'mine'\n")
    with pytest.raises(ValueError, match="must define observer, train"):
        get_method(f"{script}:Mine")
    get_method("ekf").save({"diffusion": np.ones(1)}, path)
    with pytest.raises(ValueError, match="'ekf', not 'gru'"):
        get_method("gru").load(path)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"one\.safetensors is damaged .*; remove it to train again"):
        get_method("ekf").load(path)
