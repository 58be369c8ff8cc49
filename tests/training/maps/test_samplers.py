"""Batches: what they hold, and that the observer shows its network the same."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from linear_system import TwoUnits
from small_runs import CPU, closed_loop, open_loop, untrained

from observers import Artifact, KKLObserver
from training.filter_noise import noise_covariance
from training.maps.networks import Network
from training.maps.samplers import AGE_UNIT, ClosedLoopSampler, TrajectorySampler
from training.spectrum import Spectrum
from training.trajectories.closed_loop import record_closed_loop
from training.trajectories.record import Motions, record, recording_ages
from training.trajectories.signals import KINDS


@pytest.fixture(scope="module")
def sampler():
    return open_loop()


@pytest.fixture(scope="module")
def disturbed_sampler():
    return open_loop(process_noise_share=0.5)


def test_batches_cover_quiet_and_loud(sampler):
    sampler, _, _ = sampler
    inputs, x, weight, cell = sampler(torch.Generator().manual_seed(0))
    assert inputs.shape == (4096, len(sampler.coordinates.noise_gain) + 2)
    assert x.shape == (4096, 2)
    assert torch.isfinite(inputs).all()
    assert (weight > 0).all()
    noise_free = inputs[:, -2] == 0
    assert 0.15 < noise_free.float().mean() < 0.25
    assert ((cell % 7 == 0) == noise_free).all()
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
    level = (0.02 * torch.expm1(inputs[:, -2].double())).numpy()
    assert (level == 0).mean() == pytest.approx(noise_free_share, abs=0.01)
    for below in (0.05, 0.2):  # of which a part of the two decades below 0.5 is left out
        expected = noise_free_share + (1 - noise_free_share) * (1 + np.log10(below / 0.5) / 2) ** high_noise_emphasis
        assert (level <= below).mean() == pytest.approx(expected, abs=0.01)


def test_motions_of_the_systems_own_parameters_are_in_cells_apart(sampler):
    _, data, linear = sampler
    nominal = np.arange(data.x.shape[1]) % 3 == 0
    size = np.where(nominal, 0.0, 1e6)  # by which the states say whose they are
    marked = dataclasses.replace(data, x=data.x * 0 + size[:, None] + 1, nominal=nominal)
    alike, apart = (
        TrajectorySampler(each, linear, measurement_noise_max=0.5, batch=1024, device=CPU)
        for each in (dataclasses.replace(marked, nominal=None), marked)
    )
    assert apart.cells == 2 * alike.cells
    together, found = (each(torch.Generator().manual_seed(0)) for each in (alike, apart))
    torch.testing.assert_close(found.inputs, together.inputs)
    own = (found.x[:, 0] < found.x[:, 0].mean()).long()
    torch.testing.assert_close(found.cell, 2 * together.cell + own)
    assert 0.25 < own.float().mean() < 0.42


def test_batches_hold_the_noise_that_the_filter_would_pass_on(sampler, monkeypatch):
    sampler, data, linear = sampler
    monkeypatch.setattr(sampler, "_noise_free_share", 0.0)
    zeros, generator = torch.zeros_like(sampler._modes), torch.Generator().manual_seed(0)
    monkeypatch.setattr(sampler, "_modes", zeros)  # what is left in the inputs is noise
    gain = sampler.coordinates.noise_gain
    whiten = sampler.coordinates.whiten
    expected = whiten @ noise_covariance(linear, data.ages)[:, 0] @ whiten.T
    sums, counts = np.zeros_like(expected), np.zeros(len(data.ages))
    for _ in range(100):
        inputs, _, _, _ = sampler(generator)
        level = 0.02 * torch.expm1(inputs[:, -2:-1]).double().numpy()
        age = AGE_UNIT * linear.dt * np.expm1(inputs[:, -1].double().numpy())
        noise = inputs[:, :-2].double().numpy() * (1 + (level * gain) ** 2) / level
        slot = np.abs(age[:, None] - data.ages * linear.dt).argmin(1)
        np.add.at(sums, slot, noise[:, :, None] * noise[:, None, :])
        np.add.at(counts, slot, 1)
    measured = sums / counts[:, None, None]
    size = np.sqrt(np.einsum("aii,ajj->aij", expected, expected))
    loud = np.ix_(range(len(data.ages)), gain > 1e-3, gain > 1e-3)
    assert np.abs((measured - expected)[loud] / size[loud]).max() < 0.12


@functools.cache
def of_two_outputs():
    """Batches along trajectories of a system whose outputs have units of their own, and what they are made of."""
    system = TwoUnits()
    linear = Spectrum((-0.5, -2.0, -8.0)).filter(2, 0.01, 1)
    motions, ages = Motions(KINDS), recording_ages(300, 20)
    data = record(system, linear, n=30, steps=300, ages=ages, rng=np.random.default_rng(0), motions=motions)
    largest, usual = (200.0, 0.2), system.measurement_noise
    sampler = TrajectorySampler(
        data, linear, measurement_noise_max=largest, batch=4096, device=CPU, measurement_noise=usual
    )
    return sampler, data, linear


def levels_in(inputs, usual):
    return 0.04 * np.array(usual) * np.expm1(inputs[:, -3:-1].double().numpy())


def test_each_of_several_outputs_has_a_level_of_its_own():
    sampler, _, _ = of_two_outputs()
    inputs, _, _, cell = sampler(torch.Generator().manual_seed(0))
    assert inputs.shape == (4096, len(sampler.coordinates.whiten) + 3)
    level = levels_in(inputs, TwoUnits().measurement_noise)
    part = level / sampler.measurement_noise_max
    assert part.max(0) == pytest.approx(1.0, abs=0.01)
    alike = np.isclose(part[:, 0], part[:, 1], rtol=1e-3)
    assert alike.mean() == pytest.approx(0.5 + 0.5 * 0.2**2, abs=0.03)
    assert (part[~alike] == 0).any(1).mean() == pytest.approx(2 * 0.2 * 0.8 / (1 - 0.2**2), abs=0.03)
    noise_free = (part == 0).all(1)
    assert noise_free.mean() == pytest.approx(0.5 * (0.2 + 0.2**2), abs=0.02)
    assert ((cell.numpy() % 7 == 0) == noise_free).all()
    loud = cell.numpy() % 7 == 6
    assert part[loud].mean() > 0.5
    assert part[~loud].mean() < 0.3
    assert cell.max() < sampler.cells


def test_batches_hold_the_noise_of_each_output(monkeypatch):
    sampler, data, linear = of_two_outputs()
    zeros, generator = torch.zeros_like(sampler._modes), torch.Generator().manual_seed(0)
    monkeypatch.setattr(sampler, "_modes", zeros)  # what is left in the inputs is noise
    whiten, gain = sampler.coordinates.whiten, sampler.noise_gain
    covariance = whiten @ noise_covariance(linear, data.ages) @ whiten.T  # (ages, outputs, modes, modes)
    inverse = sampler.inverse_map(untrained_network(sampler), linear)
    heard = gain.max(0) > 1e-3 * gain.max()  # modes that are about inputs hold no noise
    squares = []
    for _ in range(60):
        inputs, _, _, _ = sampler(generator)
        level = levels_in(inputs, TwoUnits().measurement_noise)
        age = AGE_UNIT * linear.dt * np.expm1(inputs[:, -1].double().numpy())
        slot = np.abs(age[:, None] - data.ages * linear.dt).argmin(1)
        shrink = 1 + sum((level[:, j, None] * gain[j]) ** 2 for j in range(2))
        np.testing.assert_allclose(1 / shrink[:5], [inverse.gain(tuple(one)) for one in level[:5]], rtol=1e-4)
        variance = np.einsum("nj,njmm->nm", level**2, covariance[slot])
        relative = (inputs[:, :-3].double().numpy() * shrink) ** 2 / np.where(variance > 0, variance, 1.0)
        cases = (level > 0).all(1), (level[:, 0] > 0) & (level[:, 1] == 0), (level[:, 0] == 0) & (level[:, 1] > 0)
        squares.append([relative[case][:, heard].mean() for case in cases])
        assert not relative[(level == 0).all(1)].any()
    np.testing.assert_allclose(np.mean(squares, 0), 1.0, atol=0.05)


def untrained_network(sampler):
    return Network(len(sampler.coordinates.whiten) + 3, 2, width=8, depth=1, activation="tanh")


def test_batches_of_two_outputs_are_what_the_observer_shows_its_network():
    sampler, data, linear = of_two_outputs()
    inputs, x, _, _ = sampler(torch.Generator().manual_seed(0))
    network = untrained_network(sampler)
    artifact = Artifact(linear, sampler.inverse_map(network, linear), "two-units", {})
    assert artifact.inverse.measurement_noise_max == (200.0, 0.2)
    assert artifact.inverse.measurement_noise_unit == pytest.approx((4.0, 0.0048))
    with torch.no_grad():
        x_hat = network(inputs).numpy() * sampler.scale.scale + sampler.scale.offset
    quiet = (inputs[:, -3:-1] == 0).all(1)
    observer = KKLObserver(artifact, measurement_noise=0.0)
    for row in torch.nonzero(quiet)[::40, 0].tolist():
        state = x[row].numpy() * sampler.scale.scale + sampler.scale.offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        shown = observer._states(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
        np.testing.assert_allclose(shown, x_hat[row], atol=1e-4)


def test_batches_are_what_the_observer_shows_its_network(sampler, monkeypatch):
    sampler, data, linear = sampler
    monkeypatch.setattr(sampler, "_noise_free_share", 1.0 - 1e-6)
    inputs, x, _, _ = sampler(torch.Generator().manual_seed(0))
    network, artifact = untrained(sampler, linear)
    with torch.no_grad():
        x_hat = network(inputs).numpy() * sampler.scale.scale + sampler.scale.offset
    observer = KKLObserver(artifact, measurement_noise=0.0)
    for row in (torch.nonzero(inputs[:, -2] == 0)[::500, 0]).tolist():
        state = x[row].numpy() * sampler.scale.scale + sampler.scale.offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        shown = observer._states(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
        np.testing.assert_allclose(shown, x_hat[row], atol=1e-4)


def test_batches_hold_what_the_observer_tells_of_process_noise(disturbed_sampler):
    sampler, data, linear = disturbed_sampler
    assert 15 < (data.process_noise > 0).sum() < 35
    inputs, x, _, cell = sampler(torch.Generator().manual_seed(0))
    assert cell.max() < sampler.cells
    network, artifact = untrained(sampler, linear)
    assert artifact.inverse.features == ("z_y", "z_u", "measurement_noise", "process_noise", "age")
    with torch.no_grad():
        x_hat = network(inputs).numpy() * sampler.scale.scale + sampler.scale.offset
    for row in (torch.nonzero(inputs[:, -3] == 0)[::50, 0]).tolist():  # without measurement noise
        state = x[row].numpy() * sampler.scale.scale + sampler.scale.offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        level = data.process_noise[trajectory]
        observer = KKLObserver(artifact, 0.0, process_noise=level)
        shown = observer._states(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
        np.testing.assert_allclose(shown, x_hat[row], atol=1e-4)
        assert cell[row] % 3 == int(level > 0) + int(level > 0.025)
        assert cell[row] // 3 % 7 == 0


@pytest.mark.parametrize("process_noise_share", [0.0, 0.5])
def test_closed_loop_batches_are_what_the_observer_shows_its_network(process_noise_share):
    sampler, data, artifact, _ = closed_loop(process_noise_share)
    inputs, x, weight, cell = sampler(torch.Generator().manual_seed(0))
    assert len(inputs) == len(x) == len(weight) == len(cell) == 4096
    assert (cell[:2048] < sampler.open_loop.cells).all()
    assert ((cell[2048:] >= sampler.open_loop.cells) & (cell[2048:] < sampler.cells)).all()
    network, inverse = artifact.inverse.mlp, artifact.inverse
    for row in range(2048, 4096, 200):
        state = x[row].numpy() * inverse.x_scale + inverse.x_offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        levels = data.measurement_noise[trajectory], float(data.process_noise[trajectory])
        observer = KKLObserver(artifact, levels[0], process_noise=levels[1])
        shown = observer._states(data.z[slot, trajectory], float(data.ages[slot] * artifact.filter.dt))
        expected = network(inputs[row : row + 1].numpy())[0] * inverse.x_scale + inverse.x_offset
        np.testing.assert_allclose(shown, expected, atol=1e-3)
        at_run_time = cell[row] - sampler.open_loop.cells
        if sampler.open_loop.process_noise_max:
            level = data.process_noise[trajectory]
            assert at_run_time % 3 == int(level > 0) + int(level > 0.025)
            at_run_time = at_run_time // 3
        assert (at_run_time % 7 == 0) == (data.measurement_noise[trajectory] == 0)


def test_closed_loop_motions_of_the_systems_own_parameters_are_in_cells_apart(sampler):
    _, open_data, linear = sampler
    _, data, _, _ = closed_loop()
    nominal = np.arange(data.x.shape[1]) % 2 == 0
    data = dataclasses.replace(data, x=data.x * 0 + np.where(nominal, 1.0, 1e6)[:, None], nominal=nominal)
    apart = dataclasses.replace(open_data, nominal=np.arange(open_data.x.shape[1]) % 2 == 0)
    beside = TrajectorySampler(apart, linear, measurement_noise_max=0.5, batch=4096, device=CPU)
    both = ClosedLoopSampler(beside, data, dt=linear.dt, device=CPU)
    _, x, _, cell = both(torch.Generator().manual_seed(0))
    x, cell = x[2048:, 0], cell[2048:]
    assert (both.kinds_of_plant, both.cells) == (2, 2 * beside.cells)
    assert ((cell >= beside.cells) & (cell < both.cells)).all()
    torch.testing.assert_close(cell % 2, (x < x.mean()).long())


def test_closed_loop_batches_of_two_outputs():
    sampler, _, linear = of_two_outputs()
    network = untrained_network(sampler)
    artifact = Artifact(linear, sampler.inverse_map(network, linear), "two-units", {})
    data = record_closed_loop(
        TwoUnits(),
        artifact,
        lambda x_hat: np.zeros((len(x_hat), 1)),
        n=50,
        steps=10,
        ages=np.array([0, 5, 10]),
        rng=np.random.default_rng(0),
    )
    part = data.measurement_noise / (200.0, 0.2)
    assert part.shape == (50, 2)
    assert 0.9 < part.max() <= 1.0
    assert 0.3 < np.isclose(part[:, 0], part[:, 1]).mean() < 0.8
    assert ((part == 0).sum(1) == 1).any()
    inputs, x, _, cell = ClosedLoopSampler(sampler, data, dt=linear.dt, device=CPU)(torch.Generator().manual_seed(0))
    with torch.no_grad():
        x_hat = network(inputs).numpy() * sampler.scale.scale + sampler.scale.offset
    for row in range(2048, 4096, 200):
        state = x[row].numpy() * sampler.scale.scale + sampler.scale.offset
        slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
        observer = KKLObserver(artifact, data.measurement_noise[trajectory])
        shown = observer._states(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
        np.testing.assert_allclose(shown, x_hat[row], atol=1e-3)
        assert ((cell[row] - sampler.cells) % 7 == 0) == (part[trajectory] == 0).all()
