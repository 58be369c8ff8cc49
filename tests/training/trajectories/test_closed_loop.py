"""Trajectories of a controller that acts on the estimate."""

import numpy as np
import pytest
from small_runs import closed_loop, open_loop, untrained

from kkl_gym import VanDerPol
from observers import KKLObserver
from training.trajectories.closed_loop import record_closed_loop


def test_the_controller_acts_on_the_estimate_under_noise_of_every_level():
    _, data, artifact, seen = closed_loop(0.5)
    assert data.x.shape == (len(data.ages), len(data.measurement_noise), 2)
    assert data.z.shape == (len(data.ages), len(data.measurement_noise), artifact.filter.size)
    assert 50 <= len(data.measurement_noise) <= 60
    (level,) = data.measurement_noise.T
    assert len(np.unique(level)) >= 5
    assert ((level >= 0) & (level <= 1.0)).all()
    assert 0.2 < (data.process_noise > 0).mean() < 0.8
    noise_free = (level == 0) & (data.process_noise == 0)
    start = KKLObserver(artifact, 0.0, process_noise=0.0).reset(data.x[0, noise_free, :1])
    assert noise_free.any()
    assert any(np.allclose(start[:1], x_hat[:1], atol=1e-6) for x_hat in seen)
    states = {tuple(row) for row in data.x.reshape(-1, 2).round(6).tolist()}
    assert not any(tuple(row) in states for x_hat in seen for row in x_hat.round(6).tolist())


@pytest.mark.parametrize(
    ("noise_free_share", "high_noise_emphasis", "process_noise_share"),
    [(0.2, 2.0, 0.3), (1.0, 2.0, 0.0), (0.0, 0.5, 1.0)],
)
def test_how_often_there_is_each_noise_level(noise_free_share, high_noise_emphasis, process_noise_share):
    sampler, _, linear = open_loop(0.5)
    _, artifact = untrained(sampler, linear)
    data = record_closed_loop(
        VanDerPol(),
        artifact,
        lambda x_hat: np.zeros((len(x_hat), 1)),
        n=50,  # each a group of its own
        steps=1,
        ages=np.array([0, 1]),
        rng=np.random.default_rng(0),
        noise_free_share=noise_free_share,
        high_noise_emphasis=high_noise_emphasis,
        process_noise_share=process_noise_share,
    )
    level = data.measurement_noise
    assert len(level) == 50
    assert (level == 0).mean() == pytest.approx(noise_free_share, abs=0.021)
    assert level.max() <= artifact.inverse.measurement_noise_max
    for below in (0.1, 0.4):  # of which a part of the two decades below 1 is left out
        expected = noise_free_share + (1 - noise_free_share) * (1 + np.log10(below) / 2) ** high_noise_emphasis
        assert (level <= below).mean() == pytest.approx(expected, abs=0.021)
    assert (data.process_noise > 0).mean() == pytest.approx(
        process_noise_share, abs=0.15 * (process_noise_share % 1 > 0)
    )
    assert data.process_noise.max() <= VanDerPol.process_noise
