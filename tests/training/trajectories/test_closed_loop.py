"""Trajectories of a controller that acts on the estimate."""

import numpy as np
import pytest
from small_runs import closed_loop

from observers import KKLObserver


@pytest.mark.parametrize("process_noise_share", [0.0, 0.5])
def test_the_controller_acts_on_the_estimate_under_noise_of_every_level(process_noise_share):
    _, data, artifact, seen = closed_loop(process_noise_share)
    assert data.x.shape == (len(data.ages), len(data.measurement_noise), 2)
    assert data.z.shape == (len(data.ages), len(data.measurement_noise), artifact.filter.size)
    assert 50 <= len(data.measurement_noise) <= 60
    assert len(np.unique(data.measurement_noise)) >= 5
    assert ((data.measurement_noise >= 0) & (data.measurement_noise <= 1.0)).all()
    disturbed = (data.process_noise > 0).mean()
    assert 0.2 < disturbed < 0.8 if process_noise_share else disturbed == 0
    noise_free = (data.measurement_noise == 0) & (data.process_noise == 0)
    start = KKLObserver(artifact, 0.0, process_noise=0.0).reset(data.x[0, noise_free, :1])
    assert noise_free.any()
    assert any(np.allclose(start[:1], x_hat[:1], atol=1e-6) for x_hat in seen)
    states = {tuple(row) for row in data.x.reshape(-1, 2).round(6).tolist()}
    assert not any(tuple(row) in states for x_hat in seen for row in x_hat.round(6).tolist())
