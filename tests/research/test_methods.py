"""The methods of the benchmark: each trains and observes, and each is right where the truth is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from linear_system import F, Oscillator, TwoOutputs, sylvester
from scipy.linalg import expm

from examples.research.certificates.smooth import decoder
from examples.research.methods import ABLATION, METHODS, Budget, Task, get_method
from examples.research.methods.kalmannet import Gain, KalmanNetFilter
from examples.research.methods.recurrent import rollout
from examples.research.methods.rkn import Belief, predict, update
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from kkl_gym.systems import VanDerPol
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
    method = get_method(name)
    system = VanDerPol() if name == "ekf-wrong" else Oscillator()  # which has no parameters to be wrong about
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
@pytest.mark.parametrize(("name", "steps", "tolerance"), [("spinn", 1000, 0.1), ("ae", 800, 0.05)])
def test_the_forward_map_of_a_linear_system_is_the_sylvester_solution(name, steps, tolerance, tmp_path):
    _, system, artifact, _ = trained_on_oscillator(name, tmp_path, steps=steps)
    x = np.random.default_rng(1).uniform(*system.box(), (1000, 2))
    z = x @ sylvester(artifact.filter.A, artifact.filter.B).T
    assert np.sqrt(((artifact.forward(x) - z) ** 2).mean() / (z**2).mean()) < tolerance
    back = decoder(artifact, 0.0)(z)  # long after the start, without noise
    assert np.sqrt(((back - x) ** 2).mean() / (x**2).mean()) < max(3 * tolerance, 0.05)  # T's error, magnified


@pytest.mark.research
@pytest.mark.parametrize("name", ["default", "dmf", "node", "gru", "kalmannet", "rkn"])
def test_each_learned_method_learns(name, tmp_path):
    steps, most = {"gru": (200, 0.3), "kalmannet": (60, 0.05), "rkn": (150, 0.2)}.get(name, (600, 0.2))
    method, system, trained, dt = trained_on_oscillator(name, tmp_path, steps=steps)
    x = oscillations(dt)
    late = (run(method.observer(trained, system, dt, 0.0), system.output(x)) - x)[len(x) // 2 :]
    assert np.sqrt((late**2).mean() / (x**2).mean()) < most


def test_the_observer_of_node_forgets_its_start_at_the_rate_that_it_learned(tmp_path):
    method, system, artifact, dt = trained_on_oscillator("node", tmp_path, configuration=1, steps=100)
    slowest = -artifact.filter.A.diagonal().max()
    assert slowest != pytest.approx(1.0, abs=1e-4)  # where it began
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
def test_kalman_filters_know_the_noise(name):
    method, system = get_method(name), get_system("van_der_pol")
    trained, y0 = {"diffusion": np.array([0.01])}, np.array([[3.0]])
    first = [run(method.observer(trained, system, 0.01, noise), y0[None])[0, 0, 0] for noise in (0.0, 50.0)]
    assert first[0] == pytest.approx(3.0, abs=0.01)  # from the centre of X, 0
    assert first[1] == pytest.approx(3.0 * (25 / 3) / (25 / 3 + 2500), rel=1e-6)
    assert get_method("ekf-wrong").believed(system).parameters == pytest.approx({"mu": 3.3})


def with_gain(system, dt, gain, noise=0.0):
    """KalmanNet whose network has the same gain, (nx, ny), for any input."""
    network = Gain(system, dt, hidden=4)
    with torch.no_grad():
        network.gain.weight.zero_()
        network.gain.bias.copy_(torch.as_tensor(np.ravel(gain)))
    arrays = {key: value.numpy().copy() for key, value in network.state_dict().items()}
    return KalmanNetFilter(arrays, system, dt, noise)


@pytest.mark.parametrize("system", [Oscillator(), TwoOutputs()])
def test_kalmannet_with_a_constant_gain_is_luenbergers_observer(system):
    K = np.array([[0.3, -0.1], [0.2, 0.25]])[:, : system.ny]
    C, step = np.eye(2)[: system.ny], expm(F * 0.1)
    y = np.random.default_rng(0).normal(size=(50, 4, system.ny))
    x, expected = np.zeros((4, 2)), []
    for k, sample in enumerate(y):
        x = x @ step.T if k else x
        x = x + (sample - x @ C.T) @ K.T
        expected.append(x)
    np.testing.assert_allclose(run(with_gain(system, 0.1, K), y), expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["kalmannet", "rkn"])
def test_rows_are_independent_and_begin_again_where_they_are_not_finite(name, tmp_path):
    method, system, trained, dt = trained_on_oscillator(name, tmp_path, steps=1, samples=10, duration=2.0)
    y = np.random.default_rng(0).normal(size=(30, 2, 1))
    y[10, 0] = np.nan
    x_hat, other = (run(method.observer(trained, system, dt, 0.0), one) for one in (y, y[:, 1:]))
    assert np.isfinite(x_hat).all()
    np.testing.assert_allclose(x_hat[:, 1:], other, atol=1e-4)
    fresh = run(method.observer(trained, system, dt, 0.0), y[11:, :1])
    np.testing.assert_allclose(x_hat[11:, :1], fresh, atol=1e-4)


N, M, BAND = 5, 6, 2  # rows, components of each half, diagonals of RKN's transitions


def dense(belief):
    """Mean (n, 2m) and covariance (n, 2m, 2m)."""
    covariance = torch.diag_embed(belief.variance.flatten(1))
    covariance[:, :M, M:] = covariance[:, M:, :M] = torch.diag_embed(belief.side)
    return belief.mean.flatten(1).numpy(), covariance.numpy()


def test_rkns_steps_are_those_of_dense_gaussians():
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.5, 2.0, (N, 2, M))
    side = rng.uniform(-1, 1, (N, M)) * np.sqrt(variance.prod(1))
    belief = Belief(*(torch.as_tensor(part) for part in (rng.normal(size=(N, 2, M)), variance, side)))
    mean, P = dense(belief)
    w, noise = rng.normal(size=(N, M)), rng.uniform(0.1, 2.0, (N, M))
    H, R = np.eye(M, 2 * M), np.stack([np.diag(row) for row in noise])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    updated = dense(update(belief, torch.as_tensor(w), torch.as_tensor(noise)))
    np.testing.assert_allclose(updated[0], mean + (K @ (w - mean @ H.T)[..., None])[..., 0], rtol=1e-10)
    np.testing.assert_allclose(updated[1], (np.eye(2 * M) - K @ H) @ P, atol=1e-12)

    transition, drift = rng.normal(size=(N, 2, 2, 2 * BAND + 1, M)), rng.uniform(size=(2, M))
    A = np.zeros((N, 2, M, 2, M))
    for row in range(M):
        for column in range(max(0, row - BAND), min(M, row + BAND + 1)):
            A[:, :, row, :, column] = transition[..., column - row + BAND, row]
    A = A.reshape(N, 2 * M, 2 * M)
    found_mean, found_P = dense(predict(belief, torch.as_tensor(transition), torch.as_tensor(drift)))
    np.testing.assert_allclose(found_mean, np.einsum("nij,nj->ni", A, mean), rtol=1e-10, atol=1e-12)
    expected = A @ P @ A.mT + np.diag(drift.ravel())
    kept = found_P != 0  # the diagonals of the four blocks
    np.testing.assert_allclose(found_P[kept], expected[kept], rtol=1e-10)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("name = label = 'mine'", "must define observer, train"),
        ("label = 'mine'\n    train = observer = None", "class variables name and label"),
        ("name = label = 'ekf'\n    train = observer = None", "takes the name 'ekf' of another"),
    ],
)
def test_methods_and_files_that_are_no_methods(body, message, tmp_path):
    script, path = tmp_path / "mine.py", tmp_path / "one.safetensors"
    script.write_text(f"from examples.research.methods import Method\n\n\nclass Mine(Method):\n    {body}\n")
    with pytest.raises(ValueError, match=message):
        get_method(f"{script}:Mine")
    get_method("ekf").save({"diffusion": np.ones(1)}, path)
    with pytest.raises(ValueError, match="'ekf', not 'gru'"):
        get_method("gru").load(path)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"one\.safetensors is damaged .*; remove it to train again"):
        get_method("ekf").load(path)
