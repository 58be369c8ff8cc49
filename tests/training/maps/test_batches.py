"""Batches: noise levels, weights, and inputs of the network that equal those of the observer."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch
from linear_system import TwoUnits
from small_runs import BATCHES, CPU, open_loop, untrained

from observers.decoder import Decoder
from training.maps.coordinates import noise_covariance
from training.maps.inverse import TrajectorySampler
from training.spectrum import Spectrum
from training.trajectories.motions import KINDS, Motions, recording_ages


def batches_of(data, linear, measurement_noise=0.5, **settings):
    return TrajectorySampler(
        data, linear, replace(BATCHES, **settings), device=CPU, measurement_noise=measurement_noise
    )


@pytest.mark.parametrize(("noise_free_share", "high_noise_emphasis"), [(0.2, 2.0), (1.0, 2.0), (0.0, 1e-3)])
def test_distribution_of_noise_levels_in_batches(noise_free_share, high_noise_emphasis):
    _, data, linear = open_loop()
    how = {"noise_free_share": noise_free_share, "high_noise_emphasis": high_noise_emphasis}
    batches = batches_of(data, linear, measurement_noise_max=0.5, batch=32_768, **how)
    inputs, x, weight, cell = batches(torch.Generator().manual_seed(0))
    assert x.shape == (32_768, 2)
    assert torch.isfinite(inputs).all()
    assert (weight > 0).all()
    level = (0.02 * torch.expm1(inputs[:, -2].double())).numpy()
    assert ((cell % 7 == 0).numpy() == (level == 0)).all()
    assert cell.max() < batches.cells
    assert (level == 0).mean() == pytest.approx(noise_free_share, abs=0.01)
    for below in (0.05, 0.2):  # levels cover two decades below 0.5
        expected = noise_free_share + (1 - noise_free_share) * (1 + np.log10(below / 0.5) / 2) ** high_noise_emphasis
        assert (level <= below).mean() == pytest.approx(expected, abs=0.01)


def test_motions_with_nominal_parameters_have_their_own_cells():
    _, data, linear = open_loop()
    nominal = np.arange(data.x.shape[1]) % 3 == 0
    size = np.where(nominal, 0.0, 1e6)  # marks the states
    marked = replace(data, x=data.x * 0 + size[:, None] + 1, nominal=nominal)
    alike, apart = (batches_of(each, linear, batch=1024) for each in (replace(marked, nominal=None), marked))
    assert apart.cells == 2 * alike.cells
    together, found = (each(torch.Generator().manual_seed(0)) for each in (alike, apart))
    torch.testing.assert_close(found.inputs, together.inputs)
    own = (found.x[:, 0] < found.x[:, 0].mean()).long()
    torch.testing.assert_close(found.cell, 2 * together.cell + own)
    assert 0.25 < own.float().mean() < 0.42


@cache
def of_two_outputs():
    """Batches for a system whose outputs have different units, the trajectories, and the filter."""
    system = TwoUnits()
    linear = Spectrum((-0.5, -2.0, -8.0)).filter(2, 0.01, 1)
    motions = Motions(system, linear.dt, 300, KINDS)
    data = motions.beside(linear, recording_ages(300, 20), 30, np.random.default_rng(0))
    sampler = batches_of(data, linear, system.measurement_noise, measurement_noise_max=(200.0, 0.2))
    return sampler, data, linear


def test_each_output_has_its_own_noise_level():
    sampler, _, linear = of_two_outputs()
    inverse = untrained(sampler, linear)[1].inverse
    inputs, _, _, cell = sampler(torch.Generator().manual_seed(0))
    assert inputs.shape == (4096, len(inverse.whiten) + 3)
    part = 0.04 * np.array(TwoUnits().measurement_noise) * np.expm1(inputs[:, -3:-1].double().numpy()) / (200.0, 0.2)
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


@pytest.mark.parametrize(("made", "largest"), [(open_loop, 1.0), (of_two_outputs, (200.0, 0.2))])
def test_batches_hold_the_noise_of_the_filter_state(made, largest):
    sampler, data, linear = made()
    usual = TwoUnits().measurement_noise if made is of_two_outputs else 0.5
    quiet = batches_of(data, linear, usual, measurement_noise_max=largest, noise_free_share=1.0)
    inverse, ny = untrained(sampler, linear)[1].inverse, np.size(largest)
    whiten, gain = inverse.whiten, np.atleast_2d(inverse.noise_gain)
    covariance = whiten @ noise_covariance(linear, data.ages) @ whiten.T  # (ages, outputs, modes, modes)
    heard = gain.max(0) > 1e-3 * gain.max()  # modes of the inputs have no noise
    measured, expected, count = 0.0, 0.0, 0
    for seed in range(30):
        inputs, without = (
            each(torch.Generator().manual_seed(seed)).inputs.double().numpy() for each in (sampler, quiet)
        )
        level = inverse.measurement_noise_unit * np.expm1(inputs[:, len(whiten) : len(whiten) + ny])
        age = inverse.age_unit * np.expm1(inputs[:, -1])
        slot = np.abs(np.minimum(age[:, None], inverse.age_max) - data.ages * linear.dt).argmin(1)
        shrink = 1 + ((level[..., None] * gain) ** 2).sum(1)
        noise = (inputs[:, : len(whiten)] * shrink - without[:, : len(whiten)])[:, heard]
        assert np.abs(noise[(level == 0).all(1)]).max() < 1e-5
        some = (level == 0).sum(1) == (seed % 2 if ny > 1 else 0)  # rows with one exact output of two, or with none
        predicted = np.einsum("nj,njab->nab", level[some] ** 2, covariance[slot[some]])[:, heard][..., heard]
        size = np.sqrt(np.einsum("naa->na", predicted))
        measured += np.einsum("na,nb->ab", noise[some] / size, noise[some] / size)
        expected += (predicted / size[:, :, None] / size[:, None]).sum(0)
        count += some.sum()
    np.testing.assert_allclose(measured / count, expected / count, atol=0.03)


def assert_shown(batch, row, artifact, data):
    """Assert that a noiseless row equals the observer's input of its network; return the row's trajectory."""
    inverse = artifact.inverse
    state = batch.x[row].numpy() * inverse.x_scale + inverse.x_offset
    slot, trajectory = np.argwhere(np.isclose(data.x, state, atol=1e-5).all(-1))[0]
    process = float(data.process_noise[trajectory]) if "process_noise" in inverse.features else 0.0
    level = (0.0,) * artifact.ny if artifact.ny > 1 else 0.0
    decoder = Decoder(inverse, slice(None), measurement_noise=level, process_noise=process)
    x_hat = decoder(data.z[slot, trajectory], float(data.ages[slot] * artifact.filter.dt))
    shown = inverse.x_offset + inverse.x_scale * inverse.mlp(batch.inputs[row].numpy())
    np.testing.assert_allclose(shown, x_hat, rtol=1e-3, atol=1e-4 * inverse.x_scale.max())
    return trajectory


@pytest.mark.parametrize("made", [open_loop, partial(open_loop, 0.5), of_two_outputs])
def test_batches_equal_the_observers_inputs_of_its_network(made):
    sampler, data, linear = made()
    _, artifact = untrained(sampler, linear)
    batch = sampler(torch.Generator().manual_seed(0))
    inverse = artifact.inverse
    modes, ny = len(inverse.whiten), artifact.ny
    quiet = (batch.inputs[:, modes : modes + ny] == 0).all(1)
    for row in torch.nonzero(quiet)[::50, 0].tolist():
        trajectory, cell = assert_shown(batch, row, artifact, data), batch.cell[row]
        if "process_noise" in inverse.features:
            level = data.process_noise[trajectory]
            assert cell % 3 == int(level > 0) + int(level > 0.025)
            cell = cell // 3
        assert cell % 7 == 0
