import json
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from linear_system import Oscillator, sylvester
from rich.console import Console
from scipy.integrate import solve_ivp

import training.evaluation.errors
import training.maps.optimise
import training.pipeline
import training.trajectories.record
from kkl_gym import ReverseDuffing, VanDerPol, get_system
from kkl_gym.simulate import advance_batch, simulate
from observers import Artifact, KKLObserver, LinearFilter
from training import errors, preset, presets, smape, train, unseen_trajectories
from training.config import Config, override
from training.evaluation.errors import starts
from training.filter_noise import noise_covariance, root, stationary_covariance
from training.maps.coordinates import coordinates
from training.maps.forward import ForwardProblem, on_tensors, truncation_time
from training.maps.least_squares import solve_forward
from training.maps.networks import Network, on_torch
from training.maps.samplers import AGE_UNIT, MEASUREMENT_NOISE_UNIT, ClosedLoopSampler, TrajectorySampler
from training.progress import progress_bars
from training.spectrum import Spectrum
from training.trajectories.closed_loop import record_closed_loop
from training.trajectories.derivatives import output_matrix
from training.trajectories.record import Motions, record, recording_ages, trajectories
from training.trajectories.signals import KINDS, random_inputs

CPU = torch.device("cpu")


TOY = {"trajectories": 20, "duration": 5.0, "samples": 40, "width": 16, "depth": 2, "batch": 128}


def toy(system, method="input-aware", **changes):
    steps = {"inverse_steps": 200} | ({"forward_steps": 200} if method == "spinn" else {})
    return override(preset(system, method, "fast"), TOY | steps | changes)


def backward_quadrature(x, eigenvalues):
    """T(x) = integral over tau < 0 of exp(-A tau) B h(x(tau)) for reverse Duffing, by integrating backward in time."""
    system, horizon = ReverseDuffing(), 37.0 / min(-np.array(eigenvalues))

    def field(s, state):
        f = system.f(state[:2])
        return [-f[0], -f[1], *(np.exp(np.array(eigenvalues) * s) * state[0])]

    return solve_ivp(field, (0, horizon), [*x, *np.zeros(len(eigenvalues))], method="DOP853", rtol=1e-10).y[2:, -1]


# Metrics


def test_smape_by_hand():
    x = np.array([[[3.0, 4.0]], [[0.0, 2.0]]])
    x_hat = np.array([[[0.0, 0.0]], [[0.0, 1.0]]])
    assert smape(x, x_hat)[0] == pytest.approx(100 * (2 * 5 / 5 + 2 * 1 / 3) / 2)
    assert smape(x, x_hat, skip=1)[0] == pytest.approx(100 * 2 / 3)
    assert smape(np.zeros((2, 1, 2)), np.zeros((2, 1, 2)))[0] == 0.0
    with pytest.raises(ValueError, match="cannot compare"):
        smape(x, x_hat[:1])


# Data


def test_signals_are_bounded_and_of_three_kinds():
    u = random_inputs(VanDerPol(), 8, 1000, 0.01, np.random.default_rng(0))
    assert u.shape == (1000, 8, 1)
    assert np.abs(u).max() <= 5.0
    assert not u[:, [0, 2, 4, 6]].any()
    assert all(len(np.unique(u[:, i])) < 1000 / 4 for i in (1, 5))
    assert all(len(np.unique(u[:, i])) > 1000 / 4 for i in (3, 7))


def test_pulses_end_and_leave_free_motion_behind():
    u = random_inputs(VanDerPol(), 200, 500, 0.01, np.random.default_rng(0), ("pulses",))
    last = np.array([np.flatnonzero(row).max(initial=-1) for row in u[..., 0].T])
    assert last.min() < 50
    assert 450 < last.max() < 500
    assert abs(last.mean() - 250) < 40


def test_excited_starts_lie_beyond_the_box_and_the_others_within():
    system, n = ReverseDuffing(), 400
    (x, u, level), *rest = trajectories(
        system, n=n, steps=10, dt=0.01, rng=np.random.default_rng(0), motions=Motions(lead_in_share=0.5)
    )
    low, high = system.box()
    inside = ((x[0] >= low) & (x[0] <= high)).all(-1)
    assert not rest
    assert not level.any()
    assert u.shape == (10, n, 0)
    assert inside[200:].all()
    assert 5 < (~inside[:200]).sum() < 150
    (x, *_), *_ = trajectories(
        Autonomous(), n=10, steps=10, dt=0.01, rng=np.random.default_rng(0), motions=Motions(lead_in_share=0.5)
    )
    assert np.isfinite(x).all()


def test_a_share_of_the_trajectories_is_disturbed(monkeypatch):
    system, n, seen = VanDerPol(), 400, []

    def spy(*arguments, w, **named):
        seen.append(w)
        return simulate(*arguments, w=w, **named)

    monkeypatch.setattr(training.trajectories.record, "simulate", spy)
    (x, u, level), *_ = trajectories(
        system,
        n=n,
        steps=50,
        dt=0.01,
        rng=np.random.default_rng(0),
        motions=Motions(kinds=("steps",), process_noise_share=0.25),
    )
    (w,) = seen
    assert np.array_equal(x, simulate(system, x[0], 50, 0.01, u=u, w=w))
    relative = w / (system.process_noise * np.array(system.scale))
    largest = np.abs(relative).max((0, 2))  # of 100 numbers, all but the level of a run
    assert (largest > 0).mean() == pytest.approx(0.25, abs=0.06)
    assert np.allclose(largest, level / system.process_noise, atol=0.12)
    assert ((largest > 0) == (level > 0)).all()
    quantiles = np.quantile(level[level > 0] / system.process_noise, [0.1, 0.5, 0.9])
    assert quantiles == pytest.approx(np.sqrt([0.1, 0.5, 0.9]), abs=0.12)
    assert largest.max() <= 1.0
    assert np.abs(relative.mean((0, 1))).max() < 0.01
    assert relative.std((0, 1)) == pytest.approx(relative.std(), rel=0.03)  # each component by its own scale


def test_settings_of_noise_reach_data_and_samples(monkeypatch, tmp_path):
    class ReachedError(Exception):
        pass

    seen = {}

    def note(name):
        def spy(*arguments, **named):
            seen[name] = named["motions"].process_noise_share if name == "record" else named
            if name == "record":
                return record(*arguments, **named)
            raise ReachedError

        return spy

    monkeypatch.setattr(training.pipeline, "record", note("record"))
    monkeypatch.setattr(training.pipeline, "TrajectorySampler", note("sampler"))
    small = {
        "trajectories": 5,
        "duration": 1.0,
        "samples": 10,
        "process_noise_share": 0.5,
        "noise_free_share": 0.3,
        "high_noise_emphasis": 3.0,
    }
    config = replace(preset(VanDerPol(), "input-aware", "fast"), **small)
    with pytest.raises(ReachedError):
        train(VanDerPol(), config, tmp_path / "aware", device=CPU)
    told = {
        "measurement_noise_max": 1.0,
        "batch": 1024,
        "device": CPU,
        "noise_free_share": 0.3,
        "high_noise_emphasis": 3.0,
    }
    assert seen == {"record": 0.5, "sampler": {**told, "process_noise_max": 0.05}}
    with pytest.raises(ReachedError):
        train(VanDerPol(), replace(config, process_noise_share=0.0), tmp_path / "undisturbed", device=CPU)
    assert seen == {"record": 0.0, "sampler": {**told, "process_noise_max": 0.0}}
    spinn = replace(
        preset(VanDerPol(), "spinn", "fast"), process_noise_share=0.5, trajectories=5, duration=20.0, forward_steps=1
    )
    train(VanDerPol(), replace(spinn, inverse_steps=1), tmp_path / "spinn", device=CPU)
    assert seen["record"] == 0.0


def test_recording_ages_cover_start_transient_and_end():
    ages = recording_ages(0, 5000, 200)
    assert ages[0] == 0
    assert ages[-1] == 5000
    assert (np.diff(ages) > 0).all()
    assert (ages < 50).sum() > 20
    np.testing.assert_array_equal(recording_ages(1000, 5000, 5001), np.arange(1000, 5001))


def test_recorded_filter_states_are_those_of_the_observer_at_run_time():
    system = VanDerPol()
    linear = LinearFilter(np.diag([-1.0, -3.0]), np.ones((2, 1)), 0.01, 1)
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(31, 4, 1)), rng.normal(size=(30, 4, 1))
    z = linear.run(y, u, np.array([0, 7, 30]))
    state = linear.start(y[0])
    np.testing.assert_allclose(z[0], state)
    for k in range(30):
        state = linear.advance(state, y[k], u[k], y[k + 1])
        if k == 6:
            np.testing.assert_allclose(z[1], state)
    np.testing.assert_allclose(z[2], state)
    data = record(system, linear, n=5, steps=20, ages=np.array([0, 20]), rng=rng)
    assert data.x.shape == (2, 5, 2)
    assert data.z.shape == (2, 5, 4)


def test_recording_gives_up_on_a_system_that_always_escapes():
    @dataclass(frozen=True)
    class Runaway(Oscillator):
        name: ClassVar[str] = "runaway"

        def f(self, x):
            return 50.0 * x[0], 50.0 * x[1]

    linear = LinearFilter(np.diag([-1.0]), np.ones((1, 1)), 0.01)
    with pytest.raises(ValueError, match="stayed within bounds"):
        record(Runaway(), linear, n=5, steps=200, ages=np.array([0]), rng=np.random.default_rng(0))


# Noise


def test_noise_covariance_against_simulation_at_every_age():
    linear = LinearFilter(np.diag([-0.5, -4.0, -20.0]), np.ones((3, 1)), 0.05)
    ages = np.array([0, 1, 2, 5, 50])
    n = 200_000
    y = np.random.default_rng(0).normal(size=(51, n, 1))
    e = linear.run(y, np.zeros((50, n, 0)), ages)
    for predicted, sample in zip(noise_covariance(linear, ages), e, strict=True):
        measured = sample.T @ sample / n
        size = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
        assert np.abs(measured - predicted).max() / size.max() < 0.015


def test_noise_covariance_tends_to_the_lyapunov_solution():
    linear = LinearFilter(np.diag([-0.5, -4.0]), np.ones((2, 1)), 0.01, 1)
    late = noise_covariance(linear, np.array([5000]))[0]
    np.testing.assert_allclose(late, stationary_covariance(linear), rtol=1e-9, atol=1e-15)
    assert not late[2:].any()  # the input is known exactly
    np.testing.assert_allclose(root(late) @ root(late).T, late, atol=1e-15)


def test_coordinates_make_the_signal_white_and_the_noise_diagonal():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(5000, 3)) @ np.array([[1.0, 1.0, 1.0], [0.0, 1e-3, 2e-3], [0, 0, 1e-5]]) + 7.0
    noise = np.diag([1e-3, 2e-3, 1e-3])
    found = coordinates(z, noise)
    np.testing.assert_allclose(np.cov(found(z).T, bias=True), np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found.whiten @ noise @ found.whiten.T, np.diag(found.noise_gain**2), atol=1e-3)
    assert (np.diff(found.noise_gain) >= 0).all()
    flat = coordinates(z[:, [0, 0, 0]], noise)
    assert len(flat.noise_gain) == 1  # two modes hold nothing but rounding


@pytest.fixture(scope="module")
def sampler():
    linear = LinearFilter(np.diag([-0.5, -2.0, -8.0]), np.ones((3, 1)), 0.01, 1)
    ages, rng = recording_ages(0, 500, 40), np.random.default_rng(0)
    data = record(VanDerPol(), linear, n=50, steps=500, ages=ages, rng=rng)
    return TrajectorySampler(data, linear, measurement_noise_max=1.0, batch=4096, device=CPU), data, linear


def test_batches_cover_quiet_and_loud(sampler):
    sampler, _, _ = sampler
    inputs, x, weight, cell = sampler(torch.Generator().manual_seed(0))
    assert inputs.shape == (4096, len(sampler.coordinates.noise_gain) + 2)
    assert x.shape == (4096, 2)
    assert torch.isfinite(inputs).all()
    assert (weight > 0).all()
    noise_free_share = inputs[:, -2] == 0
    assert 0.15 < noise_free_share.float().mean() < 0.25
    assert ((cell % 7 == 0) == noise_free_share).all()
    assert cell.max() < sampler.cells


@pytest.mark.parametrize(
    ("noise_free_share", "high_noise_emphasis"), [(0.0, 1.0), (0.2, 2.0), (0.5, 4.0), (1.0, 2.0), (0.0, 1e-3)]
)
def test_how_often_batches_hold_each_noise_level(sampler, noise_free_share, high_noise_emphasis):
    _, data, linear = sampler
    batches = TrajectorySampler(
        data,
        linear,
        measurement_noise_max=0.5,
        batch=32_768,
        device=CPU,
        noise_free_share=noise_free_share,
        high_noise_emphasis=high_noise_emphasis,
    )
    inputs, *_ = batches(torch.Generator().manual_seed(0))
    assert torch.isfinite(inputs).all()
    level = (MEASUREMENT_NOISE_UNIT * torch.expm1(inputs[:, -2].double())).numpy()
    assert (level == 0).mean() == pytest.approx(noise_free_share, abs=0.01)
    for below in (0.05, 0.2):  # of which a part of the two decades below 0.5 is left out
        expected = noise_free_share + (1 - noise_free_share) * (1 + np.log10(below / 0.5) / 2) ** high_noise_emphasis
        assert (level <= below).mean() == pytest.approx(expected, abs=0.01)


def test_batches_hold_the_noise_that_the_filter_would_pass_on(sampler, monkeypatch):
    sampler, data, linear = sampler
    monkeypatch.setattr(sampler, "_noise_free_share", 0.0)
    zeros, generator = torch.zeros_like(sampler._modes), torch.Generator().manual_seed(0)
    monkeypatch.setattr(sampler, "_modes", zeros)  # what is left in the inputs is noise
    gain = sampler.coordinates.noise_gain
    whiten = sampler.coordinates.whiten
    expected = whiten @ noise_covariance(linear, data.ages) @ whiten.T
    sums, counts = np.zeros_like(expected), np.zeros(len(data.ages))
    for _ in range(150):
        inputs, _, _, _ = sampler(generator)
        level = MEASUREMENT_NOISE_UNIT * torch.expm1(inputs[:, -2:-1]).double().numpy()
        age = AGE_UNIT * np.expm1(inputs[:, -1].double().numpy())
        noise = inputs[:, :-2].double().numpy() * (1 + (level * gain) ** 2) / level
        slot = np.abs(age[:, None] - data.ages * linear.dt).argmin(1)
        np.add.at(sums, slot, noise[:, :, None] * noise[:, None, :])
        np.add.at(counts, slot, 1)
    measured = sums / counts[:, None, None]
    size = np.sqrt(np.einsum("aii,ajj->aij", expected, expected))
    loud = np.ix_(range(len(data.ages)), gain > 1e-3, gain > 1e-3)
    assert np.abs((measured - expected)[loud] / size[loud]).max() < 0.1


def test_batches_are_what_the_observer_shows_its_network(sampler, monkeypatch):
    sampler, data, linear = sampler
    monkeypatch.setattr(sampler, "_noise_free_share", 1.0 - 1e-6)
    inputs, x, _, _ = sampler(torch.Generator().manual_seed(0))
    network = Network(inputs.shape[1], 2, width=8, depth=1, activation="tanh")
    artifact = Artifact(linear, sampler.inverse_map(network, linear), "van_der_pol", {"mu": 3.0})
    with torch.no_grad():
        x_hat = network(inputs).numpy() * sampler.x_scale + sampler.x_offset
    observer = KKLObserver(artifact, measurement_noise=0.0)
    for row in (torch.nonzero(inputs[:, -2] == 0)[::500, 0]).tolist():
        state = x[row].numpy() * sampler.x_scale + sampler.x_offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        shown = observer._invert(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
        np.testing.assert_allclose(shown, x_hat[row], atol=1e-4)


@pytest.fixture(scope="module")
def disturbed_sampler():
    linear = LinearFilter(np.diag([-0.5, -2.0, -8.0]), np.ones((3, 1)), 0.01, 1)
    motions, ages, rng = Motions(KINDS, process_noise_share=0.5), recording_ages(0, 500, 40), np.random.default_rng(0)
    data = record(VanDerPol(), linear, n=50, steps=500, ages=ages, rng=rng, motions=motions)
    sampler = TrajectorySampler(
        data,
        linear,
        measurement_noise_max=1.0,
        batch=4096,
        device=CPU,
        process_noise_max=VanDerPol.process_noise,
    )
    return sampler, data, linear


def test_batches_hold_what_the_observer_tells_of_process_noise(disturbed_sampler):
    sampler, data, linear = disturbed_sampler
    assert 15 < (data.process_noise > 0).sum() < 35
    inputs, x, _, cell = sampler(torch.Generator().manual_seed(0))
    assert cell.max() < sampler.cells
    network = Network(inputs.shape[1], 2, width=8, depth=1, activation="tanh")
    artifact = Artifact(linear, sampler.inverse_map(network, linear), "van_der_pol", {"mu": 3.0})
    assert artifact.inverse.features == ("z_y", "z_u", "measurement_noise", "process_noise", "age")
    with torch.no_grad():
        x_hat = network(inputs).numpy() * sampler.x_scale + sampler.x_offset
    for row in (torch.nonzero(inputs[:, -3] == 0)[::50, 0]).tolist():  # without measurement noise
        state = x[row].numpy() * sampler.x_scale + sampler.x_offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        level = data.process_noise[trajectory]
        observer = KKLObserver(artifact, 0.0, process_noise=level)
        shown = observer._invert(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
        np.testing.assert_allclose(shown, x_hat[row], atol=1e-4)
        assert cell[row] % 3 == int(level > 0) + int(level > 0.025)
        assert cell[row] // 3 % 7 == 0


# Closed loop


@pytest.fixture(scope="module", params=["sampler", "disturbed_sampler"])
def closed_loop(request):
    open_loop, _, linear = request.getfixturevalue(request.param)
    network = Network(
        len(open_loop.coordinates.noise_gain) + 2 + bool(open_loop.process_noise_max),
        2,
        width=8,
        depth=1,
        activation="tanh",
    )
    artifact = Artifact(linear, open_loop.inverse_map(network, linear), "van_der_pol", {"mu": 3.0})
    seen = []

    def act(x_hat):
        seen.append(x_hat)
        return np.tanh(x_hat[:, :1])

    ages = recording_ages(0, 200, 30)
    data = record_closed_loop(
        VanDerPol(),
        artifact,
        act,
        n=60,
        steps=200,
        ages=ages,
        rng=np.random.default_rng(1),
        process_noise_share=0.5,
    )
    return ClosedLoopSampler(open_loop, data, dt=linear.dt, device=CPU), data, artifact, seen


def test_the_controller_acts_on_the_estimate_under_noise_of_every_level(closed_loop):
    _, data, artifact, seen = closed_loop
    assert data.x.shape == (len(data.ages), len(data.measurement_noise), 2)
    assert data.z.shape == (len(data.ages), len(data.measurement_noise), artifact.filter.size)
    assert 50 <= len(data.measurement_noise) <= 60
    assert len(np.unique(data.measurement_noise)) >= 5
    assert ((data.measurement_noise >= 0) & (data.measurement_noise <= 1.0)).all()
    process_noise_share = (data.process_noise > 0).mean()
    assert 0.2 < process_noise_share < 0.8 if artifact.process_noise_max else process_noise_share == 0
    noise_free = (data.measurement_noise == 0) & (data.process_noise == 0)
    start = KKLObserver(artifact, 0.0, process_noise=0.0).reset(data.x[0, noise_free, :1])
    assert noise_free.any()
    assert any(np.allclose(start[:1], x_hat[:1], atol=1e-6) for x_hat in seen)
    states = {tuple(row) for row in data.x.reshape(-1, 2).round(6).tolist()}
    assert not any(tuple(row) in states for x_hat in seen for row in x_hat.round(6).tolist())


def test_closed_loop_batches_are_what_the_observer_shows_its_network(closed_loop):
    sampler, data, artifact, _ = closed_loop
    inputs, x, weight, cell = sampler(torch.Generator().manual_seed(0))
    assert len(inputs) == len(x) == len(weight) == len(cell) == 4096
    assert (cell[:2048] < sampler.open_loop.cells).all()
    assert ((cell[2048:] >= sampler.open_loop.cells) & (cell[2048:] < sampler.cells)).all()
    network, inverse = artifact.inverse.mlp, artifact.inverse
    for row in range(2048, 4096, 200):
        state = x[row].numpy() * inverse.x_scale + inverse.x_offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        levels = float(data.measurement_noise[trajectory]), float(data.process_noise[trajectory])
        observer = KKLObserver(artifact, levels[0], process_noise=levels[1])
        shown = observer._invert(data.z[slot, trajectory], float(data.ages[slot] * artifact.filter.dt))
        expected = network(inputs[row : row + 1].numpy())[0] * inverse.x_scale + inverse.x_offset
        np.testing.assert_allclose(shown, expected, atol=1e-3)
        at_run_time = cell[row] - sampler.open_loop.cells
        if sampler.open_loop.process_noise_max:
            level = data.process_noise[trajectory]
            assert at_run_time % 3 == int(level > 0) + int(level > 0.025)
            at_run_time = at_run_time // 3
        assert (at_run_time % 7 == 0) == (data.measurement_noise[trajectory] == 0)


def test_a_run_is_not_resumed_for_another_process_noise(tmp_path):
    config = toy(Oscillator(), duration=1.0)
    train(Oscillator(), config, tmp_path, device=CPU)

    class Disturbed(Oscillator):
        process_noise = 0.5

    with pytest.raises(ValueError, match=r"process_noise = 0\.05 there, 0\.5 here"):
        train(Disturbed(), config, tmp_path, resume=True, device=CPU)


def test_closing_the_loop_is_a_second_stage(tmp_path):
    system = Oscillator()
    config = toy(system, duration=5.0, closed_loop_trajectories=20)
    result = train(system, config, tmp_path)
    assert list(result.losses) == ["free", "inverse", "closed-loop"]
    assert result.artifact.training["closed_loop_trajectories"] == 20
    again = train(system, config, tmp_path, resume=True)
    for a, b in zip(result.artifact.inverse.mlp.weights, again.artifact.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="no inputs"):
        train(Autonomous(), toy(Autonomous(), closed_loop_trajectories=20, inverse_steps=5), tmp_path / "b")


@dataclass(frozen=True)
class Autonomous(Oscillator):
    name: ClassVar[str] = "autonomous"
    u_max: ClassVar[tuple[float, ...]] = ()
    G: ClassVar[tuple[tuple[float, ...], ...]] = ()


# Forward map


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol", "rossler", "lorenz"])
def test_residual_is_the_pde_by_finite_differences(name):
    system = get_system(name)
    linear = LinearFilter(np.diag([-1.0, -2.0, -3.0]), np.ones((3, 1)), 0.01)
    rng = np.random.default_rng(0)
    low, high = system.box()
    x, z = rng.uniform(low, high, (100, system.nx)), rng.normal(size=(100, 3))
    torch.manual_seed(0)
    problem = ForwardProblem(
        Network(system.nx, 3, width=16, depth=2, activation="tanh"),
        system,
        linear=linear,
        x=x,
        z=z,
        physics_weight=1.0,
        batch=64,
        device=CPU,
    ).double()
    for attribute in ("_xo", "_xs", "_zo", "_zs", "_A", "_B"):
        setattr(problem, attribute, getattr(problem, attribute).double())
    points = torch.as_tensor(x[:10])
    f, h = on_tensors(system.f, points), on_tensors(system.h, points)
    eps = 1e-5 / (1.0 + f.norm(dim=-1, keepdim=True))
    derivative = (problem.T(points + eps * f) - problem.T(points - eps * f)) / (2 * eps)
    expected = derivative - problem.T(points) @ problem._A.T - h @ problem._B.T
    residual, _ = problem.residual(points)
    torch.testing.assert_close(residual.detach(), expected, rtol=1e-5, atol=1e-5)


def test_truncation_time_leaves_epsilon():
    A = np.array([[-1.0, 5.0], [0.0, -2.0]])
    linear = LinearFilter(A, np.ones((2, 1)), 0.01)
    t = truncation_time(linear, 10.0, 1e-6)
    poles, V = np.linalg.eig(A)
    left = np.linalg.norm((V * np.exp(poles * t)) @ np.linalg.inv(V), 2) * 10.0
    assert left <= 1e-6
    assert t == pytest.approx(np.log(np.linalg.cond(V) * 10.0 / 1e-6))


def test_truncation_beyond_the_trajectories_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="make them longer"):
        train(Oscillator(), toy(Oscillator(), "spinn"), tmp_path)


@pytest.mark.slow
def test_linear_system_gives_the_sylvester_solution(tmp_path):
    system = Oscillator()
    sizes = {"trajectories": 200, "duration": 30.0, "samples": 200, "width": 64, "depth": 2, "batch": 1024}
    steps = {"forward_steps": 12000, "inverse_steps": 50, "learning_rate": 2e-3, "physics_weight": 1.0}
    config = replace(override(preset(system, "spinn", "fast"), sizes | steps), activation="silu")
    artifact = train(system, config, tmp_path).artifact
    M = sylvester(np.diag(config.eigenvalues), np.ones((len(config.eigenvalues), 1)))
    x = np.random.default_rng(0).uniform(*system.box(), (1000, 2))
    error = artifact.forward(x) - x @ M.T
    relative = np.sqrt((error**2).mean() / ((x @ M.T) ** 2).mean())
    print(f"relative RMS error {relative:.2e}")
    assert relative < 1e-3


def test_complex_modes_filter_a_linear_system_to_its_sylvester_solution():
    system = Oscillator()
    linear = Spectrum((-2.0,), ((-0.9, 1.7), (-1.5, 0.4))).filter(1, 0.01)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(linear.A)),
        np.sort_complex([-2.0, -0.9 + 1.7j, -0.9 - 1.7j, -1.5 + 0.4j, -1.5 - 0.4j]),
    )
    data = record(system, linear, n=20, steps=2500, ages=np.array([2400, 2500]), rng=np.random.default_rng(0))
    np.testing.assert_allclose(data.z, data.x @ sylvester(linear.A, linear.B).T, atol=1e-4)  # as holding y is exact


def test_a_pair_of_modes_can_be_trained(tmp_path):
    system = Oscillator()
    config = toy(system, eigenvalues=(-3.0,), pairs=((-0.5, 1.0),), inverse_steps=20)
    train(system, config, tmp_path).artifact.save(tmp_path / "a.safetensors")
    artifact = Artifact.read(tmp_path / "a.safetensors")
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(artifact.filter.A)), [-3, -0.5 - 1j, -0.5 + 1j])
    assert artifact.filter.size == 3 * (1 + system.nu)


def test_backward_quadrature_solves_the_pde():
    eigenvalues, eps = [-1.5, -3.0], 1e-4
    x, system = np.array([1.2, -0.7]), ReverseDuffing()
    f = np.array(system.f(x))
    ahead, behind = (backward_quadrature(x + sign * eps * f, eigenvalues) for sign in (1, -1))
    derivative = (ahead - behind) / (2 * eps)
    np.testing.assert_allclose(derivative, eigenvalues * backward_quadrature(x, eigenvalues) + x[0], atol=1e-6)


def test_shipped_forward_map_of_reverse_duffing_against_backward_quadrature():
    from observers.artifact import resolve

    artifact = Artifact.read(resolve("reverse_duffing-spinn-v1"))
    eigenvalues = artifact.filter.A.diagonal()
    x = np.random.default_rng(0).uniform(*ReverseDuffing().box(), (60, 2))
    truth = np.array([backward_quadrature(point, eigenvalues) for point in x])
    error = artifact.forward(x) - truth
    assert np.sqrt((error**2).mean()) < 2e-2 * np.sqrt((truth**2).mean())


def test_solved_forward_map_of_reverse_duffing_against_backward_quadrature():
    """One map, in X and beyond."""
    system, linear = ReverseDuffing(), Spectrum((-1.5, -1.875, -2.25, -2.625, -3.0)).filter(1, 0.01)
    T = solve_forward(system, linear, features=800, box_factor=2.0, rng=np.random.default_rng(0))
    rng = np.random.default_rng(1)
    inside = rng.uniform(*system.box(), (40, 2))
    beyond = rng.uniform(*system.box(2), (80, 2))
    beyond = beyond[(np.abs(beyond) > 2).any(1)]
    for x in (inside, beyond):
        truth = np.array([backward_quadrature(point, linear.A.diagonal()) for point in x])
        assert np.sqrt(np.square(T(x) - truth).sum() / np.square(truth).sum()) < 1e-3
    on_tensors_too = on_torch(T, CPU)(torch.as_tensor(inside, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(on_tensors_too, T(inside), atol=1e-4)


def test_solved_forward_map_of_a_linear_system():
    linear = Spectrum((-1.0, -2.0, -3.0)).filter(1, 0.01)
    T = solve_forward(Oscillator(), linear, features=100, box_factor=1.0, rng=np.random.default_rng(0))
    x = np.random.default_rng(1).uniform(-1, 1, (50, 2))
    expected = x @ sylvester(linear.A, linear.B).T
    assert np.abs(T(x) - expected).max() < 1e-2 * np.abs(expected).max()


def test_what_cannot_be_solved():
    pair = LinearFilter(np.array([[-1.0, 2.0], [-2.0, -1.0]]), np.ones((2, 1)), 0.01)
    with pytest.raises(ValueError, match="diagonal"):
        solve_forward(Oscillator(), pair, features=10, box_factor=1.0, rng=np.random.default_rng(0))

    class Tight(Oscillator):
        name = "oscillator"
        bounds = ((-1.0, 1.0), (-1.0, 1.0))

        def f(self, x):
            return 100.0 + x[0], 100.0 + x[1]

    with pytest.raises(ValueError, match="too soon"):
        solve_forward(
            Tight(), Spectrum((-1.0,)).filter(1, 0.01), features=1000, box_factor=1.0, rng=np.random.default_rng(0)
        )
    for wrong in ({"box_factor": 0.5}, {"box_factor": 2.0}, {"random_features": -1}, {"random_features": 10}):
        with pytest.raises(ValueError, match=r"features|box_factor"):
            replace(preset(ReverseDuffing(), "spinn", "fast"), **wrong)
    with pytest.raises(ValueError, match="does not go with"):
        replace(preset(ReverseDuffing(), "input-aware", "fast"), random_features=10)


def test_training_on_a_solved_map(tmp_path):
    sizes = {
        "random_features": 200,
        "forward_steps": 0,
        "box_factor": 1.5,
        "inverse_steps": 2000,
        "duration": 15.0,
        "width": 32,
    }
    config = toy(Oscillator(), "spinn", **sizes)
    result = train(Oscillator(), config, tmp_path)
    assert list(result.losses) == ["inverse"]
    assert result.artifact.forward.mlp.weights[0].shape == (200, 2)
    runs = unseen_trajectories(Oscillator(), config.dt, n=20, duration=20.0, seed=0, domain="1.5X")
    # long after the start, whose last traces in z an inverse of exact T(x) magnifies
    assert np.median(errors(result.artifact, Oscillator(), runs, measurement_noise=0.0, seed=0, skip=12.0).late) < 5.0


# Whole runs


def test_training_makes_the_error_fall(tmp_path):
    system = Oscillator()
    config = toy(system, trajectories=100, duration=20.0, inverse_steps=1500, width=32)
    runs = unseen_trajectories(system, config.dt, n=20, duration=20.0, seed=0)
    before = train(system, replace(config, inverse_steps=1), tmp_path / "a").artifact
    after = train(system, config, tmp_path / "b").artifact
    errors_before, errors_after = (
        np.median(errors(a, system, runs, measurement_noise=0.0, seed=0).late) for a in (before, after)
    )
    assert errors_after < 0.1 * errors_before
    assert errors_after < 5.0
    driven = unseen_trajectories(system, config.dt, n=20, duration=20.0, seed=0, driven=True)
    assert np.median(errors(after, system, driven, measurement_noise=0.0, seed=0).late) < 10.0


@pytest.mark.parametrize("method", ["input-aware", "spinn"])
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(tmp_path, monkeypatch, method):
    system = Oscillator()
    config = toy(system, method, duration=20.0, inverse_steps=400)
    whole = train(system, config, tmp_path / "whole").artifact

    monkeypatch.setattr(training.maps.optimise, "CHECKPOINT_SECONDS", 0.0)
    save, saved = training.maps.optimise._save, []

    def save_and_stop(stage, parts, generator, course):
        save(stage, parts, generator, course)
        saved.append(course.step)
        if stage.name == "inverse" and course.step == 200:
            raise KeyboardInterrupt

    monkeypatch.setattr(training.maps.optimise, "_save", save_and_stop)
    with pytest.raises(KeyboardInterrupt):
        train(system, config, tmp_path / "cut")
    monkeypatch.setattr(training.maps.optimise, "_save", save)
    resumed = train(system, config, tmp_path / "cut", resume=True)
    for a, b in zip(whole.inverse.mlp.weights, resumed.artifact.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(a, b)
    assert resumed.losses["inverse"][-1][0] == 400
    assert (whole.free_inverse is not None) == (method == "input-aware")
    if whole.free_inverse:
        for a, b in zip(whole.free_inverse.mlp.weights, resumed.artifact.free_inverse.mlp.weights, strict=True):
            np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="seed = 0 there, 1 here"):
        train(system, replace(config, seed=1), tmp_path / "cut", resume=True)
    with pytest.raises(ValueError, match="--resume"):
        train(system, config, tmp_path / "cut")
    checkpoint = tmp_path / "cut" / "inverse.checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    with pytest.raises(ValueError, match="damaged"):
        train(system, config, tmp_path / "cut", resume=True)


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

    monkeypatch.setattr(training.maps.optimise, "CHECKPOINT_SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        fit(stop_after=150)  # the checkpoint is of step 100
    spent = training.maps.optimise.seconds_spent(tmp_path)
    assert 1.5 < spent < 3.0
    rest = fit()
    assert 4.0 <= training.maps.optimise.seconds_spent(tmp_path) < 4.1
    assert rest == pytest.approx(100 * (4.0 - spent) / spent, rel=0.1)
    assert rates[-1] < 1e-4  # the learning rate has followed the clock to zero
    assert fit() == 0


def test_resuming_notices_a_changed_equation(tmp_path):
    @dataclass(frozen=True)
    class Changed(Oscillator):
        name: ClassVar[str] = "oscillator"

        def f(self, x):
            return x[1], -2.0 * x[0]

    train(Oscillator(), toy(Oscillator()), tmp_path)
    with pytest.raises(ValueError, match="equations"):
        train(Changed(), toy(Oscillator()), tmp_path, resume=True)


def test_artifact_of_a_run_records_what_made_it(tmp_path):
    system = Oscillator()
    artifact = train(system, toy(system, "spinn", duration=20.0), tmp_path).artifact
    artifact.save(tmp_path / "o.safetensors")
    read = Artifact.read(tmp_path / "o.safetensors")
    assert read.training["pipeline"] == "spinn"
    assert read.training["seed"] == 0
    assert read.versions["torch"] == torch.__version__
    assert read.forward is not None
    assert read.nu == 0
    assert json.loads((tmp_path / "config.json").read_text())["forward_steps"] == 200
    x = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    np.testing.assert_allclose(read.forward(x), artifact.forward(x))


def test_output_matrix_of_linear_and_other_outputs():
    @dataclass(frozen=True)
    class Squared(Oscillator):
        name: ClassVar[str] = "squared"

        def h(self, x):
            return (x[0] * x[0],)

    np.testing.assert_array_equal(output_matrix(get_system("rossler")), [[0.0, 1.0, 0.0]])
    assert output_matrix(Squared()) is None


def test_two_outputs_train_and_run(tmp_path):
    @dataclass(frozen=True)
    class Both(Oscillator):
        name: ClassVar[str] = "both"

        def h(self, x):
            return x[0], x[0] + x[1]

    artifact = train(Both(), toy(Both(), duration=20.0), tmp_path).artifact
    assert artifact.ny == 2
    assert KKLObserver(artifact).estimate(np.zeros((10, 3, 2)), np.zeros((9, 3, 1))).shape == (10, 3, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, "dt"),
        ({"eigenvalues": (1.0,)}, "eigenvalues"),
        ({"eigenvalues": (-1.0, -1.0)}, "distinct"),
        ({"pairs": ((0.1, 1.0),)}, "pairs"),
        ({"pairs": ((-0.1, -1.0),)}, "pairs"),
        ({"pairs": ((-0.1, 1.0), (-0.1, 1.0))}, "distinct"),
        ({"eigenvalues": ()}, "needs eigenvalues"),
        ({"forward_steps": 5}, "forward_steps"),
        ({"width": 0}, "width"),
        ({"batch": 2}, "batch"),
        ({"batch": 100}, "batch"),
        ({"samples": 1}, "samples"),
        ({"pipeline": "bogus"}, "pipeline"),
        ({"activation": "relu"}, "activation"),
        ({"trajectories": 2.5}, "trajectories"),
        ({"seed": -1}, "seed"),
        ({"measurement_noise_max": float("nan")}, "measurement_noise_max"),
        ({"process_noise_share": 1.5}, "share"),
        ({"noise_free_share": float("nan")}, "share"),
        ({"high_noise_emphasis": 0.0}, "high_noise_emphasis"),
        ({"closed_loop_trajectories": 5}, "closed_loop"),
    ],
)
def test_impossible_configurations(change, message):
    with pytest.raises(ValueError, match=message):
        replace(preset(Oscillator(), "input-aware", "fast"), **change)


def test_paper_preset_has_the_papers_table():
    config = preset(VanDerPol(), "spinn", "paper")
    assert (config.width, config.depth, config.activation, config.learning_rate) == (512, 4, "silu", 1e-3)
    assert config.physics_weight == 0.1
    assert len(config.eigenvalues) == 5
    assert (max(config.eigenvalues), min(config.eigenvalues)) == (-1.5, -3.0)
    assert isinstance(config, Config)
    assert all(value < 0 for value in presets.eigenvalues(Oscillator()))


# Evaluation


def test_starts_outside_lie_outside():
    system = VanDerPol()
    x0 = starts(system, "2X", 50, np.random.default_rng(0))
    low, high = system.box()
    assert ((x0 < low) | (x0 > high)).any(-1).all()
    assert (np.abs(x0) <= 2 * high).all()


def test_process_noise_in_evaluation_disturbs_the_motion_and_is_told(make_artifact, monkeypatch):
    system, told = VanDerPol(), []
    noise_free_share, loud = (
        unseen_trajectories(system, 0.01, n=20, duration=1.0, seed=0, process_noise=level) for level in (0.0, 0.15)
    )
    assert np.array_equal(noise_free_share.x[0], loud.x[0])
    x, w, u = loud.x.transpose(0, 2, 1), np.zeros((2, 20)), np.zeros((1, 20))
    for k in (0, 50):
        drift = (x[k + 1] - advance_batch(system, x[k], u, w, 0.01)) / 0.01 / np.array(system.scale)[:, None]
        assert 0.05 < np.abs(drift).max() < 0.16

    class Spy(KKLObserver):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            told.append(self.process_noise)

    monkeypatch.setattr(training.evaluation.errors, "KKLObserver", Spy)
    for runs in (noise_free_share, loud, loud.first(5)):
        errors(make_artifact(), system, runs, measurement_noise=0.5, seed=0)
    assert told == [0.0, 0.15, 0.15]


@pytest.mark.parametrize(
    "wrong",
    [{"n": 0}, {"duration": 0.0}, {"domain": "3X"}, {"seed": -1}, {"process_noise": -1.0}, {"process_noise": np.nan}],
)
def test_impossible_evaluations(wrong):
    with pytest.raises(ValueError, match=r"cannot run|domain|process_noise must"):
        unseen_trajectories(**{"system": VanDerPol(), "dt": 0.01, "n": 1, "duration": 1.0, "seed": 0} | wrong)


def test_escapes_are_counted():
    runs = unseen_trajectories(get_system("rossler"), 0.01, n=200, duration=20.0, seed=0, domain="2X")
    assert runs.escaped > 0
    assert runs.x.shape[1] == 200 - runs.escaped
    assert np.isfinite(runs.x).all()


def test_output_of_constant_and_state():
    x = np.arange(12.0).reshape(2, 3, 2)
    np.testing.assert_array_equal(Oscillator().output(x), x[..., :1])


# Command line


def test_train_evaluate_and_report_from_the_command_line(tmp_path, capsys, monkeypatch):
    from training.cli import main

    monkeypatch.chdir(tmp_path)
    toy_sizes = "--trajectories 20 --duration 5 --samples 30 --width 16 --depth 1 --batch 128 --inverse-steps 50"
    main(["train", "van_der_pol", *toy_sizes.split(), "--threads", "1", "--no-monitor"])
    path = tmp_path / "runs" / "van_der_pol" / "van_der_pol.safetensors"
    assert path.exists()
    assert (path.parent / "report.png").stat().st_size > 10_000
    csv = tmp_path / "errors.csv"
    main(["evaluate", str(path), "--trajectories", "3", "--duration", "8", "--csv", str(csv)])
    assert "2X" in capsys.readouterr().out
    assert len(csv.read_text().splitlines()) == 1 + 3 * 3 * 2
    for wrong in (
        ["train", "nonsense"],
        ["evaluate", "nonsense"],
        ["evaluate"],
        ["train", "lorenz", "--dt", "0"],
        ["train", "lorenz", "--parameters", "rh", "30"],
        ["train", "lorenz", "--threads", "0"],
        ["train", "lorenz", "--out", "/dev/null/x", *toy_sizes.split()],
    ):
        with pytest.raises(SystemExit, match="kkl-gym: "):
            main(wrong)


def test_demo_and_maps(tmp_path, capsys):
    from training.cli import main

    main(["demo", "--out", str(tmp_path), "--duration", "1"])
    main(["maps"])
    out = capsys.readouterr().out
    assert "KKLLorenz-v0" in out
    assert "van_der_pol-spinn" in out
    assert (tmp_path / "estimates.png").stat().st_size > 10_000


def test_speed_measures_every_environment(capsys):
    from training.commands.speed import Speed

    ratios = Speed(steps=20, turns=1, num_envs=8, vector_steps=5).run(Console(width=200))
    assert len(ratios) == 9 + 13
    printed = capsys.readouterr().out
    assert "simulation" in printed
    assert "KKLLorenz-v0, z" in printed
    assert all(ratio > 0 for ratio in ratios.values())
