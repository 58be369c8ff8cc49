"""Rows that follow training trajectories by chunks."""

import numpy as np
import pytest
import torch

from examples.research.methods import Data
from examples.research.methods.chunks import Chunks, error


@pytest.fixture
def data():
    """Outputs that say the trajectory and the age, and states that say the same."""
    ages, trajectories = np.array([0, 1, 2, 5, 30, 59]), 7
    y = 100.0 * np.arange(trajectories)[None, :] + np.arange(60)[:, None]
    return Data(ages, np.stack([y[ages], -y[ages]], -1), y[..., None].astype(np.float32))


def test_rows_go_on_through_a_trajectory_and_then_begin_another_one(data):
    chunks, generator = Chunks(data, 0.0, samples=10, rows=50), torch.Generator().manual_seed(0)
    drawn = [chunks.draw(generator) for _ in range(30)]
    assert drawn[0].fresh.all()
    y = torch.stack([chunk.y[..., 0] for chunk in drawn]).numpy()  # (chunks, samples, rows)
    trajectory, age = y // 100, y % 100
    np.testing.assert_array_equal(age, age[:, :1] + np.arange(10)[:, None])
    fresh = np.stack([chunk.fresh.numpy() for chunk in drawn])
    np.testing.assert_array_equal(age[:, 0] == 0, fresh)
    np.testing.assert_array_equal(np.diff(trajectory[:, 0], axis=0)[~fresh[1:]], 0)
    np.testing.assert_array_equal(np.diff(age[:, 0], axis=0)[~fresh[1:]], 10)
    assert set(age[-1, 0]) == {0, 10, 20, 30, 40, 50}  # rows are of all ages at once
    assert set(trajectory.ravel()) == set(range(7))


def test_states_are_those_at_the_recorded_ages(data):
    chunks, generator = Chunks(data, 0.0, samples=10, rows=20), torch.Generator().manual_seed(0)
    for _ in range(5):
        chunk = chunks.draw(generator)
        y = chunk.y[..., 0].numpy()
        np.testing.assert_array_equal(chunk.recorded.numpy(), np.isin(y % 100, data.ages))
        x = chunks.x_offset + chunks.x_scale * chunk.x.numpy()
        np.testing.assert_allclose(x[:, 0], y[chunk.recorded.numpy()], rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(x[:, 1], -x[:, 0], rtol=1e-5, atol=1e-3)


def test_half_of_the_trajectories_have_noise_of_any_level_up_to_the_systems_own(data):
    exact, noisy = (Chunks(data, level, samples=60, rows=2000) for level in (0.0, 0.4))
    y = [chunks.draw(torch.Generator().manual_seed(0)).y[..., 0].numpy() for chunks in (exact, noisy)]
    spread = (y[1] - y[0]).std(0)
    assert (spread == 0).mean() == pytest.approx(0.5, abs=0.05)
    assert np.median(spread[spread > 0]) == pytest.approx(0.2, abs=0.02)
    assert spread.max() == pytest.approx(0.4, rel=0.3)
    level = noisy.level[:, 0].numpy()
    np.testing.assert_allclose(spread, 0.4 * level, rtol=0.5, atol=1e-6)


def test_a_chunk_is_no_longer_than_the_trajectories(data):
    chunks = Chunks(data, 0.0, samples=500, rows=3)
    for _ in range(2):
        chunk = chunks.draw(torch.Generator().manual_seed(0))
        assert chunk.fresh.all()
        assert chunk.y.shape == (60, 3, 1)


def test_the_error_is_the_mean_length():
    differences = torch.tensor([[3.0, 4.0], [0.0, 1.0]])
    assert float(error(differences)) == pytest.approx(3.0, rel=1e-6)
    assert float(error(differences[:0])) == 0.0
