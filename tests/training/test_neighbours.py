import numpy as np
import pytest

from training.neighbours import told


def samples(n, modes, seed):
    return np.random.default_rng(seed).uniform(-1, 1, (n, modes))


def test_what_is_left_is_the_part_of_x_that_does_not_follow_from_z():
    z, others = samples(500, 3, 0), samples(6000, 3, 1)
    noise, others_noise = (np.sqrt(3) * samples(n, 1, 2)[:, 0] for n in (500, 6000))  # of variance 1

    def x(z, noise):
        bent = np.sin(2 * z[:, 0]) * z[:, 1]
        return np.stack([bent, bent + 0.3 * noise, 2 * z[:, 2] + noise, noise, 0 * noise], -1)

    found = told(z, x(z, noise), others_z=others, others_x=x(others, others_noise))
    size = x(z, noise).std(0)
    assert found.left[0] < 0.05
    np.testing.assert_allclose(found.left[1:4] * size[1:4], [0.3, 1.0, 1.0], rtol=0.1)
    assert found.linear[0] > 0.9
    assert found.linear[2] * size[2] == pytest.approx(1.0, rel=0.1)
    assert np.isnan(found.left[4])


def test_directions_below_the_resolution_tell_nothing():
    z, others = samples(300, 2, 0) * [1, 1e-6], samples(4000, 2, 1) * [1, 1e-6]
    bent = told(z, (1e6 * z[:, 1:]) ** 2, others_z=others, others_x=(1e6 * others[:, 1:]) ** 2)
    assert bent.left[0] > 0.8


def test_without_any_z_all_is_left():
    x, others = samples(100, 1, 0), samples(1000, 1, 1)
    found = told(np.zeros((100, 0)), x, others_z=np.zeros((1000, 0)), others_x=others)
    assert found.left[0] == found.linear[0] == pytest.approx(1.0, abs=0.02)
