"""The methods of the benchmark: each trains and observes, and each is right where the truth is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from linear_system import F, Oscillator, TwoOutputs, sylvester
from scipy.linalg import expm
from scipy.signal import bessel

from examples.research.benchmark.protocol import run
from examples.research.methods import ABLATION, METHODS, Budget, Data, Task, get_method
from examples.research.methods.chunks import Chunks
from examples.research.methods.kalman import DIFFUSION, WRONG_DIFFUSION, diffusion_intensity
from examples.research.methods.kalmannet import Gain, KalmanNetFilter, Motion
from examples.research.methods.recurrent import rollout
from examples.research.methods.rkn import Belief, predict, update
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from kkl_gym.systems import VanDerPol
from observers import Artifact, LinearFilter
from training.kalman import IteratedKalmanFilter, measurement_covariance
from training.maps.smooth import decoder

SMALL = Budget(
    "small", trajectories=100, duration=25.0, samples=60, cpu_seconds=math.inf, width=32, depth=2, dt=0.05, steps=600
)
TINY = Budget(
    "tiny", trajectories=10, duration=25.0, samples=20, cpu_seconds=math.inf, width=8, depth=1, dt=0.02, steps=2
)


def trained_on_oscillator(name, tmp_path, configuration=0, **changes):
    method, system = get_method(name), Oscillator()
    budget = replace(SMALL, **changes)
    trained = method.train(Task(system, budget, tmp_path), method.configurations(system)[configuration])
    return method, system, trained, budget.dt


def oscillations(dt, seconds=30.0, n=8, seed=0):
    system = Oscillator()
    x0 = np.random.default_rng(seed).uniform(*system.box(), (n, 2))
    return simulate(system, x0, round(seconds / dt), dt)


def late_error(x, x_hat):
    """Over the second half, relative to the size of the motion."""
    late = slice(len(x) // 2, None)
    return np.sqrt(((x_hat - x)[late] ** 2).mean() / (x[late] ** 2).mean())


@pytest.mark.parametrize(
    "name",
    [
        *METHODS,
        *(name if name == "ablation-spinn" else pytest.param(name, marks=pytest.mark.research) for name in ABLATION),
    ],
)
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
@pytest.mark.parametrize(
    ("name", "steps", "most"),
    [
        ("default", 600, 0.2),
        ("dmf", 400, 0.1),
        ("node", 600, 0.1),
        ("gru", 200, 0.3),
        ("kalmannet", 60, 0.05),
        ("rkn", 150, 0.2),
    ],
)
def test_each_learned_method_learns(name, steps, most, tmp_path):
    method, system, trained, dt = trained_on_oscillator(name, tmp_path, steps=steps)
    x = oscillations(dt)
    assert late_error(x, run(method.observer(trained, system, dt, 0.0), system.output(x))) < most


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


def test_the_autoencoder_has_the_poles_of_a_bessel_filter(tmp_path):
    method, system, artifact, _ = trained_on_oscillator("ae", tmp_path / "a", steps=3)
    cutoff = artifact.training["cutoff"]
    poles = np.sort_complex(cutoff * bessel(3, 1.0, analog=True, output="zpk", norm="phase")[1])
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(artifact.filter.A)), poles, rtol=1e-6)
    np.testing.assert_allclose(artifact.filter.B, np.full((3, 1), cutoff))
    settled = method.settled(method.configurations(system)[0], artifact)  # the cutoff is not chosen again
    again = method.train(Task(system, replace(SMALL, steps=3), tmp_path / "b"), {**settled, "cutoff": 1.25})
    assert (settled["cutoff"], again.training["cutoff"]) == (cutoff, 1.25)


@pytest.mark.parametrize("ny", [1, 2])
def test_rollout_is_the_filter_sample_by_sample(ny):
    rng = np.random.default_rng(0)
    A = -np.diag(rng.uniform(0.5, 5.0, 4)) + np.triu(rng.normal(size=(4, 4)), 1)
    linear = LinearFilter(A, rng.normal(size=(4, ny)), 0.05)
    y = rng.normal(size=(301, 3, ny))
    ages = np.array([0, 1, 2, 7, 8, 150, 300])
    expected = linear.run(y, np.zeros((300, 3, 0)), ages)
    parts = (torch.as_tensor(part) for part in (linear.transition, linear.early_y, linear.late_y))
    states = rollout(*parts, z0=torch.as_tensor(expected[0]), y=torch.as_tensor(y.swapaxes(0, 1)), ages=ages)
    np.testing.assert_allclose(states.numpy(), expected, rtol=1e-10, atol=1e-12)


def test_wrong_models_are_ten_percent_off():
    believed = get_method("ekf-wrong").believed(get_system("lorenz"))
    assert believed.parameters == pytest.approx({"sigma": 11.0, "rho": 30.8, "beta": 8.8 / 3})


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_kalman_filters_know_the_noise(name):
    method, system = get_method(name), get_system("van_der_pol")
    trained, y0 = {"diffusion": np.array([0.01])}, np.array([[3.0]])
    first = [method.observer(trained, system, 0.01, noise).reset(y0)[0, 0] for noise in (0.0, 50.0)]
    assert first[0] == pytest.approx(3.0, abs=0.01)  # from the centre of X, 0
    assert first[1] == pytest.approx(3.0 * (25 / 3) / (25 / 3 + 2500), rel=1e-6)


@pytest.mark.parametrize(("name", "levels"), [("ekf", DIFFUSION), ("ekf-wrong", WRONG_DIFFUSION)])
def test_diffusion_is_in_multiples_of_the_scale_per_root_of_a_second(name, levels):
    """Without measurements it adds its square times dt to the variance of each state."""
    method, system, dt = get_method(name), get_system("lorenz"), 1e-4
    assert [one["diffusion"] for one in method.configurations(system)] == list(levels)
    variance = []
    for level in (0.0, 0.1):
        observer = method.observer({"diffusion": np.array([level])}, system, dt, 1e9)
        observer.reset(np.zeros((1, 1)))
        observer.step(np.zeros((1, 1)))
        variance.append(np.diag(observer.P[0]))
    np.testing.assert_allclose(variance[1] - variance[0], (0.1 * np.array(system.scale)) ** 2 * dt, rtol=1e-6)


def test_the_guided_filter_begins_as_the_filter_alone():
    method, system, trained = get_method("guided"), get_system("van_der_pol"), {"diffusion": np.array([0.01])}
    y = np.array([[3.0], [-1.0]])
    ours = method.observer(trained, system, 0.01, 1.0)
    Q = diffusion_intensity(trained, system)
    alone = IteratedKalmanFilter(system, 0.01, Q=Q, R=measurement_covariance(system, 1.0))
    for one in ("reset", "step"):
        np.testing.assert_allclose(getattr(ours, one)(y), getattr(alone, one)(y), rtol=1e-12)


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


def test_kalmannets_prediction_stays_within_the_bounds_and_begins_again_where_it_escapes():
    system = VanDerPol()
    motion = Motion(system, 0.01)
    x = np.array([[12.0, 30.0], [-5.0, -30.0], [np.nan, 0.0], [1.0, 1.0]])
    moved, Phi = motion.linearised(x)
    np.testing.assert_allclose(moved, motion(x), rtol=1e-12)
    low, high = np.array(system.bounds).T
    assert ((moved >= low) & (moved <= high)).all()
    np.testing.assert_array_equal(Phi[0, 0], 0.0)  # held by the bound
    np.testing.assert_array_equal(moved[2], motion.start)
    ahead = motion(x[3] + 1e-6 * np.eye(2))
    np.testing.assert_allclose(Phi[3], ((ahead - moved[3]) / 1e-6).T, rtol=1e-4, atol=1e-6)


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


def test_chunks_go_on_through_trajectories_with_the_states_at_their_recorded_ages():
    ages, trajectories = np.array([0, 1, 2, 5, 30, 59]), 7
    y = 100.0 * np.arange(trajectories)[None, :] + np.arange(60)[:, None]  # which trajectory, and the age
    data = Data(ages, np.stack([y[ages], -y[ages]], -1), y[..., None].astype(np.float32))
    chunks, generator = Chunks(data, 0.0, samples=10, rows=50), torch.Generator().manual_seed(0)
    drawn = [chunks.draw(generator) for _ in range(30)]
    seen = torch.stack([chunk.y[..., 0] for chunk in drawn]).numpy()  # (chunks, samples, rows)
    trajectory, age = seen // 100, seen % 100
    fresh = np.stack([chunk.fresh.numpy() for chunk in drawn])
    np.testing.assert_array_equal(age, age[:, :1] + np.arange(10)[:, None])
    np.testing.assert_array_equal(age[:, 0] == 0, fresh)
    np.testing.assert_array_equal(np.diff(trajectory[:, 0], axis=0)[~fresh[1:]], 0)
    np.testing.assert_array_equal(np.diff(age[:, 0], axis=0)[~fresh[1:]], 10)
    assert set(age[-1, 0]) == {0, 10, 20, 30, 40, 50}  # rows are of all ages at once
    for chunk, own in zip(drawn, seen):
        recorded = chunk.recorded.numpy()
        np.testing.assert_array_equal(recorded, np.isin(own % 100, ages))
        x = chunks.x_offset + chunks.x_scale * chunk.x.numpy()
        np.testing.assert_allclose(x, np.stack([own[recorded], -own[recorded]], -1), rtol=1e-5, atol=1e-3)


def test_training_data_is_the_same_for_all_methods_and_matches_the_states(tmp_path):
    system = Oscillator()
    data = Task(system, SMALL, tmp_path).data
    assert data is Task(Oscillator(), replace(SMALL, cpu_seconds=1.0), tmp_path).data
    assert (data.x.shape, data.y.shape) == ((len(data.ages), 100, 2), (501, 100, 1))
    np.testing.assert_allclose(data.y[data.ages], system.output(data.x), atol=1e-6)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("name = label = 'mine'", "must define observer, train"),
        ("label = 'mine'\n    train = observer = None", "class variables name and label"),
        ("name = label = 'ekf'\n    train = observer = None", "takes the name 'ekf' of another"),
    ],
)
def test_methods_that_lack_something(body, message, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(f"from examples.research.methods import Method\n\n\nclass Mine(Method):\n    {body}\n")
    with pytest.raises(ValueError, match=message):
        get_method(f"{path}:Mine")
    with pytest.raises(ValueError, match="unknown method 'kalman'"):
        get_method("kalman")


def test_files_of_another_method_or_damaged_ones_are_refused(tmp_path):
    path = tmp_path / "one.safetensors"
    get_method("ekf").save({"diffusion": np.ones(1)}, path)
    with pytest.raises(ValueError, match="'ekf', not 'gru'"):
        get_method("gru").load(path)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"one\.safetensors is damaged .*; remove it to train again"):
        get_method("ekf").load(path)


def test_methods_that_make_artifacts_make_files_for_all_programs(tmp_path):
    method, _, trained, _ = trained_on_oscillator("node", tmp_path / "train", steps=2)
    method.save(trained, tmp_path / "node.safetensors")
    assert Artifact.read(tmp_path / "node.safetensors").training["method"] == "node"
