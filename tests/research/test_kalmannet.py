"""KalmanNet, where its gain is known."""

import math

import numpy as np
import pytest
import torch
from drawn_chunks import two_chunks
from linear_system import F, Oscillator, TwoOutputs
from scipy.linalg import expm

from examples.research.benchmark.protocol import run
from examples.research.methods import Budget, Task, get_method
from examples.research.methods.chunks import FAINT_NOISE
from examples.research.methods.kalmannet import Gain, KalmanNetFilter, Motion, _Advance, _Problem
from kkl_gym.simulate import simulate
from kkl_gym.systems import VanDerPol, get_system
from training.kalman import ExtendedKalmanFilter

SMALL = Budget("small", trajectories=100, duration=25.0, samples=60, cpu_seconds=math.inf, dt=0.05, steps=60)


def with_gain(system, dt, gain, noise=0.0):
    """A filter whose network says the same gain, (nx, ny), whatever it sees."""
    network = Gain(system, dt, hidden=4)
    with torch.no_grad():
        network.gain.weight.zero_()
        network.gain.bias.copy_(torch.as_tensor(np.ravel(gain)))
    arrays = {key: value.numpy().copy() for key, value in network.state_dict().items()}
    return KalmanNetFilter(arrays, system, dt, noise)


def with_any_gain(system, dt):
    torch.manual_seed(0)
    return KalmanNetFilter({k: v.numpy() for k, v in Gain(system, dt, hidden=8).state_dict().items()}, system, dt, 0.0)


@pytest.mark.parametrize("name", ["van_der_pol", "lorenz"])
def test_without_a_gain_it_is_the_models_own_prediction(name):
    system = get_system(name)
    system = system.replace({"mu": 1.0}) if name == "van_der_pol" else system
    y = np.random.default_rng(0).normal(size=(200, 3, 1))
    x_hat = run(with_gain(system, 0.01, np.zeros((system.nx, 1))), y)
    start = np.tile(np.mean(system.box(), 0), (3, 1))
    np.testing.assert_allclose(x_hat, simulate(system, start, 199, 0.01), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("system", [Oscillator(), TwoOutputs()])
def test_with_a_constant_gain_it_is_luenbergers_observer(system):
    K = np.array([[0.3, -0.1], [0.2, 0.25]])[:, : system.ny]
    C, step = np.eye(2)[: system.ny], expm(F * 0.1)
    y = np.random.default_rng(0).normal(size=(50, 4, system.ny))
    x, expected = np.zeros((4, 2)), []
    for k, sample in enumerate(y):
        x = x @ step.T if k else x
        x = x + (sample - x @ C.T) @ K.T
        expected.append(x)
    np.testing.assert_allclose(run(with_gain(system, 0.1, K), y), expected, rtol=1e-6, atol=1e-7)


def test_the_network_sees_the_papers_four_differences():
    """And the noise level, in multiples of the system's own."""
    system = TwoOutputs()
    observer = with_gain(system, 0.1, 0.2 * np.eye(2), (0.0, 0.15))
    seen = []
    observer._filter.inlet.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].numpy()))
    y = np.random.default_rng(0).normal(size=(4, 3, 2))
    x_hat = run(observer, y)
    before = np.stack([np.zeros_like(x_hat[0]), np.zeros_like(x_hat[0]), *x_hat])
    prior = np.concatenate([np.zeros_like(x_hat[:1]), x_hat[:-1] @ expm(F * 0.1).T])
    for k in (2, 3):
        expected = [y[k] - y[k - 1], y[k] - prior[k], before[k + 1] - before[k], x_hat[k - 1] - prior[k - 1]]
        np.testing.assert_allclose(seen[k][:, :8], np.arcsinh(np.concatenate(expected, -1)), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(seen[k][:, 8:], [[0.0, np.arcsinh(0.5 / FAINT_NOISE)]] * 3, rtol=1e-6)
    at_first = [np.zeros((3, 2)), y[0], np.zeros((3, 4))]  # nothing came before
    np.testing.assert_allclose(seen[0][:, :8], np.arcsinh(np.concatenate(at_first, -1)), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["van_der_pol", "rossler"])
def test_the_derivative_of_the_motion_is_the_sensitivity(name):
    system = get_system(name)
    x = np.random.default_rng(0).uniform(*system.box(), (5, system.nx))
    filters = ExtendedKalmanFilter(system, 0.01, Q=np.zeros((system.nx,) * 2), R=np.eye(1))
    filters.x, filters.P = x, np.tile(np.eye(system.nx), (5, 1, 1))
    expected, covariance = filters._predicted(np.zeros((1, 5)))
    at = torch.as_tensor(x).requires_grad_()
    motion = Motion(system, 0.01)
    moved = _Advance.apply(at, motion)
    np.testing.assert_allclose(moved.detach().numpy(), expected, rtol=1e-12)
    Phi = np.stack([torch.autograd.grad(moved[:, i].sum(), at, retain_graph=True)[0] for i in range(system.nx)], 1)
    np.testing.assert_allclose(Phi @ Phi.mT, covariance, rtol=1e-4, atol=1e-5)


def test_predictions_stay_within_the_bounds_and_begin_anew_where_they_escape():
    system = VanDerPol()
    motion = Motion(system, 0.01)
    x = np.array([[12.0, 30.0], [-5.0, -30.0], [np.nan, 0.0], [1.0, 1.0]])
    moved, Phi = motion.linearised(x)
    np.testing.assert_allclose(moved, motion(x), rtol=1e-12)
    low, high = np.array(system.bounds).T
    assert ((moved >= low) & (moved <= high)).all()
    assert moved[0, 0] == 12.0
    np.testing.assert_array_equal(Phi[0, 0], 0.0)  # held by the bound
    np.testing.assert_array_equal(moved[2], motion.start)
    np.testing.assert_array_equal(Phi[2], 0.0)
    assert np.abs(Phi[3]).min() > 1e-4
    x_hat = run(with_gain(system, 0.01, [[50.0], [50.0]]), np.full((5, 1, 1), 3.0))
    assert ((x_hat >= low) & (x_hat <= high)).all()


def test_rows_do_not_see_each_other():
    system = VanDerPol()
    y = np.random.default_rng(0).normal(size=(40, 3, 1))
    whole = run(with_any_gain(system, 0.01), y)
    for row in range(3):
        alone = run(with_any_gain(system, 0.01), y[:, row : row + 1])
        np.testing.assert_allclose(whole[:, row : row + 1], alone, rtol=1e-5, atol=1e-6)
    assert np.ptp(whole[-1], axis=0).min() > 1e-4


def test_a_row_that_is_not_finite_begins_anew():
    system = VanDerPol()
    y = np.random.default_rng(0).normal(size=(30, 2, 1))
    y[10, 0] = np.nan
    x_hat = run(with_any_gain(system, 0.01), y)
    np.testing.assert_array_equal(x_hat[10, 0], np.mean(system.box(), 0))
    np.testing.assert_allclose(x_hat[11:, :1], run(with_any_gain(system, 0.01), y[11:, :1]), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(x_hat[:, 1:], run(with_any_gain(system, 0.01), y[:, 1:]), rtol=1e-5, atol=1e-6)


def test_training_goes_on_as_the_observer_does(tmp_path):
    """From chunk to chunk; rows that are lost begin anew."""
    problem = _Problem(Task(Oscillator(), SMALL, tmp_path), hidden=8, chunk=20)
    generator, kept, y, told = two_chunks(problem)
    arrays = {key: value.detach().numpy() for key, value in problem.filter.state_dict().items()}
    observer = KalmanNetFilter(arrays, Oscillator(), SMALL.dt, 0.0)
    observer._told = told
    x_hat = run(observer, y)
    np.testing.assert_allclose(problem.state[kept, :2], x_hat[-1], rtol=1e-4, atol=1e-5)
    problem.state[kept.argmax(), 0] = torch.nan
    loss = problem.loss(generator)["loss"]
    loss.backward()
    assert all(value.isfinite().all() for value in (loss, problem.state, problem.memory))
    assert all(parameter.grad.isfinite().all() for parameter in problem.parameters())


def test_estimates_are_compared_with_the_motions_behind_the_outputs(tmp_path):
    """Between recorded points too: the model tells them."""
    task = Task(Oscillator(), SMALL, tmp_path)
    problem, generator = _Problem(task, hidden=8, chunk=20), torch.Generator().manual_seed(0)
    for _ in range(8):
        problem.loss(generator)
        chunks = problem.chunks
        y = task.data.y[chunks.age - 1, chunks.trajectory]
        np.testing.assert_allclose(problem.truth[:, :1], y, atol=1e-6)
    assert len(set(chunks.age.tolist())) > 2


def test_it_learns(tmp_path):
    method, system = get_method("kalmannet"), Oscillator()
    trained = method.train(Task(system, SMALL, tmp_path), method.configurations(system)[0])
    x0 = np.random.default_rng(0).uniform(*system.box(), (8, 2))
    x = simulate(system, x0, 400, SMALL.dt)
    x_hat = run(method.observer(trained, system, SMALL.dt, 0.0), system.output(x))
    late = slice(200, None)
    assert np.sqrt(((x_hat - x)[late] ** 2).mean() / (x[late] ** 2).mean()) < 0.05
