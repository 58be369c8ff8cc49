"""The recurrent Kalman network, beside dense Gaussians."""

import math

import numpy as np
import torch
from drawn_chunks import two_chunks
from linear_system import Oscillator
from scipy.linalg import block_diag

from examples.research.benchmark.protocol import run
from examples.research.methods import Budget, Task, get_method
from examples.research.methods.rkn import PACE, Belief, Cell, RKNObserver, _Problem, predict, update
from kkl_gym.simulate import simulate

SMALL = Budget("small", trajectories=100, duration=25.0, samples=60, cpu_seconds=math.inf, dt=0.05, steps=150)
N, M, BAND = 5, 6, 2


def belief(seed=0):
    rng = torch.Generator().manual_seed(seed)
    mean, variance = (torch.randn(N, 2, M, generator=rng, dtype=torch.float64) for _ in range(2))
    variance = variance.abs() + 0.5
    side = (2 * torch.rand(N, M, generator=rng, dtype=torch.float64) - 1) * variance.prod(1).sqrt()
    return Belief(mean, variance, side)


def dense(one):
    """Mean (n, 2m) and covariance (n, 2m, 2m)."""
    covariance = torch.diag_embed(one.variance.flatten(1))
    covariance[:, :M, M:] = covariance[:, M:, :M] = torch.diag_embed(one.side)
    return one.mean.flatten(1).numpy(), covariance.numpy()


def same(one, mean, covariance):
    np.testing.assert_allclose(one.mean.flatten(1), mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(one.variance.flatten(1), np.diagonal(covariance, axis1=1, axis2=2), rtol=1e-10)
    side = np.diagonal(covariance[:, :M, M:], axis1=1, axis2=2)
    np.testing.assert_allclose(one.side, side, rtol=1e-10, atol=1e-12)


def test_the_update_is_kalmans():
    rng = np.random.default_rng(0)
    w, variance = rng.normal(size=(N, M)), rng.uniform(0.1, 2.0, (N, M))
    mean, P = dense(belief())
    H = np.eye(M, 2 * M)
    R = np.stack([np.diag(row) for row in variance])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    expected = (np.eye(2 * M) - K @ H) @ P
    found = update(belief(), torch.as_tensor(w), torch.as_tensor(variance))
    same(found, mean + (K @ (w - mean @ H.T)[..., None])[..., 0], expected)
    np.testing.assert_allclose(dense(found)[1], expected, atol=1e-12)  # the update keeps all other entries at zero


def test_the_prediction_is_that_of_banded_matrices():
    rng = np.random.default_rng(0)
    transition, noise = rng.normal(size=(N, 2, 2, 2 * BAND + 1, M)), rng.uniform(size=(2, M))
    A = np.zeros((N, 2, M, 2, M))
    for row in range(M):
        for column in range(max(0, row - BAND), min(M, row + BAND + 1)):
            A[:, :, row, :, column] = transition[..., column - row + BAND, row]
    A = A.reshape(N, 2 * M, 2 * M)
    mean, P = dense(belief())
    found = predict(belief(), torch.as_tensor(transition), torch.as_tensor(noise))
    same(found, np.einsum("nij,nj->ni", A, mean), A @ P @ A.mT + np.diag(noise.ravel()))


def test_it_begins_with_rotations_of_each_pair():
    """As large as the mixture makes them, but for what tells the transitions from each other."""
    torch.manual_seed(0)
    cell = Cell(1, 2, 8)
    transition = cell.turn + PACE * cell.change.detach().mean(0)
    middle = transition.shape[2] // 2
    blocks = block_diag(*transition[:, :, middle].permute(2, 0, 1).numpy())
    np.testing.assert_allclose(blocks @ blocks.T, np.eye(16), atol=0.02)
    angles = np.arcsin(transition[0, 1, middle].numpy())
    np.testing.assert_allclose(angles[[0, -1]], [0.003, 0.3], atol=0.005)


def untrained():
    torch.manual_seed(0)
    arrays = {key: value.detach().numpy() for key, value in Cell(1, 2, 8).state_dict().items()}
    return RKNObserver({**arrays, "x_offset": np.array([1.0, 2.0]), "x_scale": np.array([3.0, 4.0])}, torch.zeros(1))


def test_rows_do_not_see_each_other():
    y = np.random.default_rng(0).normal(size=(40, 3, 1))
    whole = run(untrained(), y)
    for row in range(3):
        np.testing.assert_allclose(whole[:, row : row + 1], run(untrained(), y[:, row : row + 1]), atol=1e-4)
    assert np.ptp(whole[-1], axis=0).min() > 1e-2


def test_a_row_that_is_not_finite_begins_anew():
    y = np.random.default_rng(0).normal(size=(30, 2, 1))
    y[10, 0] = np.nan
    x_hat = run(untrained(), y)
    assert np.isfinite(x_hat).all()
    np.testing.assert_allclose(x_hat[11:, :1], run(untrained(), y[11:, :1]), atol=1e-4)
    np.testing.assert_allclose(x_hat[:, 1:], run(untrained(), y[:, 1:]), atol=1e-4)


def test_what_is_cut_stays_a_covariance():
    shape = (1, 2, 2, 1, 1)
    large = torch.tensor([40.0, 0.0, 0.0, 1.0], dtype=torch.float64).reshape(shape)
    one = Belief(
        torch.zeros(1, 2, 1).double(), torch.tensor([[[900.0], [100.0]]]).double(), torch.full((1, 1), 290.0).double()
    )
    found = predict(one, large, torch.zeros(2, 1).double())
    for each in (found, update(found, torch.zeros(1, 1).double(), torch.full((1, 1), 0.1).double())):
        assert each.variance.min() > 0
        assert (each.side**2 <= each.variance.prod(1) * (1 + 1e-9)).all()
    correlation = found.side / found.variance.prod(1).sqrt()
    np.testing.assert_allclose(correlation, 290.0 / 300.0)  # which no cut changes


def test_an_unstable_transition_stays_finite():
    observer = untrained()
    with torch.no_grad():
        observer._cell.turn.mul_(10.0)
    assert np.isfinite(run(observer, np.ones((200, 2, 1)))).all()


def test_training_goes_on_as_the_observer_does(tmp_path):
    """From chunk to chunk; rows that are lost begin anew."""
    problem = _Problem(Task(Oscillator(), SMALL, tmp_path), latent=8, chunk=20)
    generator, kept, y, told = two_chunks(problem)
    arrays = {key: value.detach().numpy() for key, value in problem.cell.state_dict().items()}
    scaling = {"x_offset": problem.chunks.x_offset, "x_scale": problem.chunks.x_scale}
    observer = RKNObserver({**arrays, **scaling}, told)
    run(observer, y)
    for found, expected in zip((problem.mean, problem.variance, problem.side), observer._belief, strict=True):
        np.testing.assert_allclose(found[kept], expected, rtol=1e-3, atol=1e-4)
    problem.mean[kept.argmax()] = torch.nan
    loss = problem.loss(generator)["loss"]
    assert all(value.isfinite().all() for value in (loss, problem.mean, problem.variance, problem.side))


def test_it_learns(tmp_path):
    method, system = get_method("rkn"), Oscillator()
    trained = method.train(Task(system, SMALL, tmp_path), method.configurations(system)[0])
    x0 = np.random.default_rng(0).uniform(*system.box(), (8, 2))
    x = simulate(system, x0, 400, SMALL.dt)
    x_hat = run(method.observer(trained, system, SMALL.dt, 0.0), system.output(x))
    late = slice(200, None)
    assert np.sqrt(((x_hat - x)[late] ** 2).mean() / (x[late] ** 2).mean()) < 0.2
