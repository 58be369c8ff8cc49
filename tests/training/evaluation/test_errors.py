"""Errors on unseen trajectories."""

import numpy as np
import pytest
from linear_system import Oscillator, Reactor, TwoOutputs, exact_observer, reactor_observer

import training.evaluation.errors
import training.maps.optimise
import training.pipeline
import training.trajectories.record
from kkl_gym import VanDerPol, get_system
from kkl_gym.simulate import advance_batch
from observers import KKLObserver
from training import errors, unseen_trajectories
from training.evaluation.errors import kalman_errors, starts
from training.filter_noise import stationary_covariance


def test_starts_outside_lie_outside():
    system = VanDerPol()
    x0 = starts(system, "2X", 50, np.random.default_rng(0))
    low, high = system.box()
    assert ((x0 < low) | (x0 > high)).any(-1).all()
    assert (np.abs(x0) <= 2 * high).all()


def test_process_noise_in_evaluation_disturbs_the_motion_and_is_told(make_artifact, monkeypatch):
    system, told = VanDerPol(), []
    calm, disturbed = (
        unseen_trajectories(system, 0.01, n=20, duration=1.0, seed=0, process_noise=level) for level in (0.0, 0.15)
    )
    assert np.array_equal(calm.x[0], disturbed.x[0])
    x, w, u = disturbed.x.transpose(0, 2, 1), np.zeros((2, 20)), np.zeros((1, 20))
    for k in (0, 50):
        drift = (x[k + 1] - advance_batch(system, x[k], u, w, 0.01)) / 0.01 / np.array(system.scale)[:, None]
        assert 0.05 < np.abs(drift).max() < 0.16

    class Spy(KKLObserver):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            told.append(self.process_noise)

    monkeypatch.setattr(training.evaluation.errors, "KKLObserver", Spy)
    for runs in (calm, disturbed, disturbed.first(5)):
        errors(make_artifact(), system, runs, measurement_noise=0.5, seed=0)
    assert told == [0.0, 0.15, 0.15]


@pytest.mark.parametrize(
    "wrong",
    [{"n": 0}, {"duration": 0.0}, {"domain": "3X"}, {"seed": -1}, {"process_noise": -1.0}, {"process_noise": np.nan}],
)
def test_impossible_evaluations(wrong):
    with pytest.raises(ValueError, match=r"cannot simulate|duration must|domain|process_noise must"):
        unseen_trajectories(**{"system": VanDerPol(), "dt": 0.01, "n": 1, "duration": 1.0, "seed": 0} | wrong)


def test_escapes_are_counted():
    runs = unseen_trajectories(get_system("rossler"), 0.01, n=200, duration=20.0, seed=0, domain="2X")
    assert runs.escaped > 0
    assert runs.x.shape[1] == 200 - runs.escaped
    assert np.isfinite(runs.x).all()


def test_output_of_constant_and_state():
    x = np.arange(12.0).reshape(2, 3, 2)
    np.testing.assert_array_equal(Oscillator().output(x), x[..., :1])


def test_an_error_of_the_small_state_shows_in_its_nrmse_and_nowhere_else():
    """A temperature of 300 K off by 0.03, a concentration of 1e-3 mol/l 2 % off."""
    system = Reactor()
    runs = unseen_trajectories(system, system.dt, n=20, duration=40 * np.pi, seed=0)
    found = errors(reactor_observer(offset=0.03, gain=1.02), system, runs, measurement_noise=0.0, seed=0)
    assert np.median(found.late) == pytest.approx(0.01, rel=0.01)
    rms = np.sqrt(((runs.x - [300, 1e-3]) ** 2).mean(0))  # of whole periods, for any radius of the circle
    size = runs.x.std((0, 1))
    np.testing.assert_allclose(found.nrmse[:, 0], 100 * 0.03 / size[0], rtol=0.02)
    np.testing.assert_allclose(found.nrmse[:, 1], 2.0 * rms[:, 1] / size[1], rtol=0.02)
    assert np.median(found.nrmse[:, 1]) == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("level", [(0.1, 0.3), (0.3, 0.0)])
def test_each_output_has_noise_of_its_level(level):
    """In closed form: the exact observer's error is what its filter makes of the noise."""
    system, artifact = TwoOutputs(), exact_observer(C=np.eye(2), name="two-outputs")
    runs = unseen_trajectories(system, 0.05, n=40, duration=100.0, seed=0)
    P = (np.reshape(level, (2, 1, 1)) ** 2 * stationary_covariance(artifact.filter)).sum(0)
    (L,) = artifact.inverse.mlp.weights
    expected = 100 * np.sqrt(np.diag(L @ P @ L.T)) / runs.x.std((0, 1))
    found = errors(artifact, system, runs, measurement_noise=level, seed=0)
    np.testing.assert_allclose(np.median(found.nrmse, axis=0), expected, rtol=0.05)


def test_levels_of_noise_that_are_none(make_artifact):
    runs = unseen_trajectories(VanDerPol(), 0.01, n=2, duration=0.1, seed=0)
    for wrong in (-0.1, np.nan, True, "0.5", (0.1, 0.2)):
        with pytest.raises(ValueError, match="measurement_noise"):
            errors(make_artifact(), VanDerPol(), runs, measurement_noise=wrong, seed=0)


def test_an_exact_kalman_filter_follows_the_same_runs():
    system, dt = Oscillator(), 0.05
    runs = unseen_trajectories(system, dt, n=20, duration=20.0, seed=0, driven=True)
    found = kalman_errors(system, runs, dt, measurement_noise=0.1, seed=0)
    assert found.nrmse.shape == (20, 2)
    assert 0.5 < np.median(found.nrmse) < 10  # noise of some 15 % of the output, averaged
    assert np.median(found.late) < np.median(found.full)
    longer = kalman_errors(system, runs, dt, measurement_noise=0.1, seed=0, skip=15.0)
    assert np.median(longer.nrmse) < np.median(found.nrmse)
    louder = kalman_errors(system, runs, dt, measurement_noise=0.4, seed=0)
    assert (louder.nrmse.mean(0) > 1.5 * found.nrmse.mean(0)).all()
