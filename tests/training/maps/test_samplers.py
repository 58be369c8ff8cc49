"""Batches: what they hold, and that the observer shows its network the same."""

import numpy as np
import pytest
import torch
from small_runs import CPU, closed_loop, open_loop, untrained

from observers import KKLObserver
from training.filter_noise import noise_covariance
from training.maps.samplers import AGE_UNIT, TrajectorySampler


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


def test_batches_hold_the_noise_that_the_filter_would_pass_on(sampler, monkeypatch):
    sampler, data, linear = sampler
    monkeypatch.setattr(sampler, "_noise_free_share", 0.0)
    zeros, generator = torch.zeros_like(sampler._modes), torch.Generator().manual_seed(0)
    monkeypatch.setattr(sampler, "_modes", zeros)  # what is left in the inputs is noise
    gain = sampler.coordinates.noise_gain
    whiten = sampler.coordinates.whiten
    expected = whiten @ noise_covariance(linear, data.ages)[:, 0] @ whiten.T
    sums, counts = np.zeros_like(expected), np.zeros(len(data.ages))
    for _ in range(150):
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
    assert np.abs((measured - expected)[loud] / size[loud]).max() < 0.1


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
        shown = observer._invert(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
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
        shown = observer._invert(data.z[slot, trajectory], float(data.ages[slot] * linear.dt))
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
        shown = observer._invert(data.z[slot, trajectory], float(data.ages[slot] * artifact.filter.dt))
        expected = network(inputs[row : row + 1].numpy())[0] * inverse.x_scale + inverse.x_offset
        np.testing.assert_allclose(shown, expected, atol=1e-3)
        at_run_time = cell[row] - sampler.open_loop.cells
        if sampler.open_loop.process_noise_max:
            level = data.process_noise[trajectory]
            assert at_run_time % 3 == int(level > 0) + int(level > 0.025)
            at_run_time = at_run_time // 3
        assert (at_run_time % 7 == 0) == (data.measurement_noise[trajectory] == 0)
