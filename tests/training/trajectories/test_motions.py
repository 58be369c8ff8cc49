"""Training trajectories."""

import numpy as np
import pytest

import training.trajectories.motions
from kkl_gym import ReverseDuffing, VanDerPol
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.trajectories.motions import (
    KINDS,
    Motions,
    random_inputs,
    recording_ages,
)


def test_excited_starts_lie_beyond_the_box_and_the_others_within():
    system, n = ReverseDuffing(), 400
    x, u, level, _ = Motions(system, 0.01, 10, lead_in_share=0.5).drawn(n, np.random.default_rng(0))
    low, high = system.box()
    inside = ((x[0] >= low) & (x[0] <= high)).all(-1)
    assert not level.any()
    assert u.shape == (10, n, 0)
    assert inside[::2].all()
    assert 5 < (~inside[1::2]).sum() < 150


def test_a_share_of_the_trajectories_is_disturbed(monkeypatch):
    system, seen = VanDerPol(), []

    def spy(*arguments, w, **named):
        seen.append(w)
        return simulate(*arguments, w=w, **named)

    monkeypatch.setattr(training.trajectories.motions, "simulate", spy)
    motions = Motions(system, 0.01, 50, ("steps",), process_noise_share=0.25)
    x, u, level, _ = motions.drawn(400, np.random.default_rng(0))
    (w,) = seen
    assert np.array_equal(x, simulate(system, x[0], 50, 0.01, u=u, w=w))
    relative, level = w / (system.process_noise * np.array(system.scale)), level / system.process_noise
    largest = np.abs(relative).max((0, 2))  # the largest of 100 uniform samples is close to the run's level
    assert (largest > 0).mean() == pytest.approx(0.25, abs=0.06)
    assert np.allclose(largest, level, atol=0.12)
    quantiles = np.quantile(level[largest > 0], [0.1, 0.5, 0.9])
    assert quantiles == pytest.approx(np.sqrt([0.1, 0.5, 0.9]), abs=0.12)
    assert np.abs(relative.mean((0, 1))).max() < 0.01
    assert relative.std((0, 1)) == pytest.approx(relative.std(), rel=0.03)  # relative to the scale of each component


def test_recording_ages_cover_start_transient_and_end():
    ages = recording_ages(5000, 200)
    assert (np.diff(ages) > 0).all()
    assert (ages < 50).sum() > 20
    for n, expected in ((2, [0, 5000]), (3, [0, 1, 5000]), (200, ages[[0, -1]])):
        assert recording_ages(5000, n)[[0, -1] if n == 200 else slice(None)].tolist() == list(expected)


def test_most_motions_start_in_a_larger_box_where_one_is_asked_for():
    system = VanDerPol()
    x, _, _, near = Motions(system, 0.01, 1, box_factor=2.0).drawn(2000, np.random.default_rng(0))
    relative = np.abs(x[0]) / np.array(system.X)[:, 1]
    assert relative.max() == pytest.approx(2.0, abs=0.02)
    assert (relative <= 1).all(1).mean() == pytest.approx(0.4 + 0.6 / 4, abs=0.04)
    assert near.mean() == pytest.approx(0.4, abs=0.04)
    assert (relative[near] <= 1).all()


class Integrator(System):
    """x' = u: without input the state is constant, and most driven motions escape."""

    name, X, bounds, u_max, G = "integrator", ((-0.5, 0.5),), ((-0.6, 0.6),), (1.0,), ((1.0,),)

    def f(self, x):
        return (0.0 * x[0],)

    def h(self, x):
        return (x[0],)


def test_escaped_motions_are_replaced_by_motions_of_the_same_kind(monkeypatch):
    n = 57
    monkeypatch.setattr(training.trajectories.motions, "CHUNK", 24)
    tried = []

    def spy(system, x0, *arguments, **named):
        tried.append(len(x0))
        return simulate(system, x0, *arguments, **named)

    monkeypatch.setattr(training.trajectories.motions, "simulate", spy)
    x, u, level, _ = Motions(Integrator(), 0.01, 200, KINDS).drawn(n, np.random.default_rng(0))
    u = u.swapaxes(0, 1)
    assert sum(tried) > 1.2 * n  # many motions escaped, most of them driven
    assert x.shape == (201, n, 1)
    assert (np.abs(x) <= 0.6).all()
    assert not level.any()
    different = np.array([len(np.unique(row)) for row in u[..., 0]])
    kinds = np.where((u == 0).all((1, 2)), "zero", np.where(different > 100, "sine", "steps"))
    expected = [KINDS[row % 4] for row in range(n)]
    for kind in ("zero", "steps", "sine"):
        assert (kinds == kind).sum() == expected.count(kind)


def test_signals_are_bounded_and_of_four_kinds():
    u = random_inputs(VanDerPol(), 8, 1000, dt=0.01, rng=np.random.default_rng(0))
    assert np.abs(u).max() <= 5.0
    assert not u[:, ::2].any()
    assert [len(np.unique(u[:, i])) < 1000 / 4 for i in (1, 3, 5, 7)] == [True, False, True, False]
    pulses = random_inputs(VanDerPol(), 200, 500, dt=0.01, rng=np.random.default_rng(0), kinds=("pulses",))
    last = np.array([np.flatnonzero(row).max(initial=-1) for row in pulses[..., 0].T])
    assert last.min() < 50
    assert 450 < last.max() < 500
    assert abs(last.mean() - 250) < 40
