"""Training trajectories, and a filter beside them."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from linear_system import Autonomous, Oscillator

import training.evaluation.errors
import training.maps.optimise
import training.pipeline
import training.trajectories.record
from kkl_gym import ReverseDuffing, VanDerPol
from kkl_gym.simulate import simulate
from observers import LinearFilter
from training.trajectories.record import Motions, record, recording_ages, trajectories


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
