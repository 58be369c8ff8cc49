"""Random inputs."""

import numpy as np

from kkl_gym import VanDerPol
from training.trajectories.signals import random_inputs


def test_signals_are_bounded_and_of_three_kinds():
    u = random_inputs(VanDerPol(), 8, 1000, dt=0.01, rng=np.random.default_rng(0))
    assert u.shape == (1000, 8, 1)
    assert np.abs(u).max() <= 5.0
    assert not u[:, [0, 2, 4, 6]].any()
    assert all(len(np.unique(u[:, i])) < 1000 / 4 for i in (1, 5))
    assert all(len(np.unique(u[:, i])) > 1000 / 4 for i in (3, 7))


def test_pulses_end_and_leave_free_motion_behind():
    u = random_inputs(VanDerPol(), 200, 500, dt=0.01, rng=np.random.default_rng(0), kinds=("pulses",))
    last = np.array([np.flatnonzero(row).max(initial=-1) for row in u[..., 0].T])
    assert last.min() < 50
    assert 450 < last.max() < 500
    assert abs(last.mean() - 250) < 40
