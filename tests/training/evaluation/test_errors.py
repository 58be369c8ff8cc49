"""Errors on unseen trajectories of the model and of other plants."""

import dataclasses

import numpy as np
import pytest
from discrete_systems import Turning
from linear_system import Oscillator, Reactor, TwoOutputs, exact_observer, reactor_observer

import training.evaluation.errors
from kkl_gym import VanDerPol, get_system
from kkl_gym.simulate import advance_batch
from observers import KKLObserver
from training import errors, noise_limit, unseen_trajectories
from training.commands.evaluate import Motions, show_parameters
from training.evaluation.errors import estimates, measured
from training.kalman import ExtendedKalmanFilter, measurement_covariance, unknown_start
from training.maps.coordinates import stationary_covariance


def test_process_noise_disturbs_the_motion_and_is_passed_to_the_observer(make_artifact, monkeypatch):
    system, levels = VanDerPol(), []
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
            levels.append(self.process_noise)

    monkeypatch.setattr(training.evaluation.errors, "KKLObserver", Spy)
    for runs in (calm, disturbed):
        errors(make_artifact(), system, runs, measurement_noise=0.5, seed=0)
    assert levels == [0.0, 0.15]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"n": 0}, "n must be positive and seed not negative, got n = 0 and seed = 0"),
        ({"duration": 0.0}, "duration must"),
        ({"domain": "3X"}, "domain must be one of X, 1.5X, 2X, got '3X'"),
        ({"process_noise": np.nan}, "process_noise must be a finite number, not negative, got nan"),
        (
            {"plant": get_system("lorenz")},
            r"a plant with \(nx, nu, ny\) = \(3, 1, 1\) does not fit van_der_pol, which has \(2, 1, 1\)",
        ),
    ],
)
def test_impossible_evaluations(wrong, message):
    with pytest.raises(ValueError, match=message):
        unseen_trajectories(**{"system": VanDerPol(), "dt": 0.01, "n": 1, "duration": 1.0, "seed": 0} | wrong)


def test_starts_outside_lie_outside_and_escapes_are_counted():
    system = get_system("rossler")
    runs = unseen_trajectories(system, 0.01, n=200, duration=20.0, seed=0, domain="2X")
    low, high = system.box()
    assert ((runs.x[0] < low) | (runs.x[0] > high)).any(-1).all()
    assert ((runs.x[0] >= system.box(2)[0]) & (runs.x[0] <= system.box(2)[1])).all()
    assert runs.escaped > 0
    assert runs.x.shape[1] == 200 - runs.escaped
    assert np.isfinite(runs.x).all()


def test_an_error_of_the_small_state_shows_in_its_nrmse_and_nowhere_else():
    """The temperature, about 300 K, is off by 0.03 K, the concentration, about 1e-3 mol/l, by 2 %."""
    system = Reactor()
    runs = unseen_trajectories(system, system.dt, n=20, duration=40 * np.pi, seed=0)
    found = errors(reactor_observer(offset=0.03, gain=1.02), system, runs, measurement_noise=0.0, seed=0)
    assert np.median(found.late) == pytest.approx(0.01, rel=0.01)
    rms = np.sqrt(((runs.x - [300, 1e-3]) ** 2).mean(0))  # over whole periods
    size = runs.x.std((0, 1))
    np.testing.assert_allclose(found.nrmse[:, 0], 100 * 0.03 / size[0], rtol=0.02)
    np.testing.assert_allclose(found.nrmse[:, 1], 2.0 * rms[:, 1] / size[1], rtol=0.02)


def test_each_output_has_noise_of_its_level():
    """In closed form, the exact observer's error is the stationary noise of its filter state."""
    system, artifact, level = TwoOutputs(), exact_observer(C=np.eye(2), name="two-outputs"), (0.1, 0.3)
    runs = unseen_trajectories(system, 0.05, n=40, duration=100.0, seed=0)
    P = (np.reshape(level, (2, 1, 1)) ** 2 * stationary_covariance(artifact.filter)).sum(0)
    (L,) = artifact.inverse.mlp.weights
    expected = 100 * np.sqrt(np.diag(L @ P @ L.T)) / runs.x.std((0, 1))
    found = errors(artifact, system, runs, measurement_noise=level, seed=0)
    np.testing.assert_allclose(np.median(found.nrmse, axis=0), expected, rtol=0.05)
    for wrong in (-0.1, np.nan, "0.5", (0.1, 0.2, 0.3)):
        with pytest.raises(ValueError, match="measurement_noise"):
            errors(artifact, system, runs, measurement_noise=wrong, seed=0)


def test_an_exact_kalman_filter_follows_the_same_runs():
    runs = unseen_trajectories(Oscillator(), 0.05, n=20, duration=20.0, seed=0, driven=True)
    found, longer, louder = (
        errors(None, Oscillator(), runs, measurement_noise=noise, seed=0, skip=skip)
        for noise, skip in ((0.1, None), (0.1, 15.0), (0.4, None))
    )
    assert found.nrmse.shape == (20, 2)
    assert 0.5 < np.median(found.nrmse) < 10  # in %, after averaging noise of about 15 %
    assert np.median(found.late) < np.median(found.full)
    assert np.median(longer.nrmse) < np.median(found.nrmse)
    assert (louder.nrmse.mean(0) > 1.5 * found.nrmse.mean(0)).all()


def test_the_limit_of_a_linear_system_is_the_error_of_its_kalman_filter():
    system, how = Oscillator(), {"measurement_noise": 0.3, "seed": 0, "skip": 2.0}
    for process_noise in (0.0, 0.1):  # at 0, the filter assumes a small process noise
        runs = unseen_trajectories(system, 0.05, n=60, duration=10.0, seed=0, driven=True, process_noise=process_noise)
        limit, exact = noise_limit(system, runs, **how), errors(None, system, runs, **how)
        squares = [(one.nrmse**2).mean(0) for one in (limit, exact)]
        np.testing.assert_allclose(*np.sqrt(squares), rtol=0.12)
        assert limit.full.mean() == pytest.approx(exact.full.mean(), rel=0.12)
    _, P = estimates(None, system, runs, measurement_noise=0.3, seed=0, covariances=True)
    Q = np.diag((0.1 * np.array(system.scale)) ** 2 / 3 * 0.05)
    bound = ExtendedKalmanFilter(system, 0.05, Q=Q, R=measurement_covariance(system, 0.3))
    np.testing.assert_allclose(bound.along(system.output(runs.x), runs.u, runs.x)[1], P, rtol=1e-6, atol=1e-9)


def test_the_limit_follows_tichavskys_recursion_on_the_plant():
    """J' = F^-T J F^-1 + H^T R^-1 H, without process noise; and the published limit of the Lorenz system."""
    model, plant, how = Turning(), Turning(omega=2.0), {"measurement_noise": 0.3, "seed": 0}
    runs = unseen_trajectories(model, 0.05, n=3, duration=1.0, seed=0, plant=plant)
    filters = ExtendedKalmanFilter(plant, 0.05, Q=np.zeros((2, 2)), R=np.array([[0.09]]))
    _, bound = filters.along(plant.output(runs.x), runs.u, runs.x)
    c, s = np.cos(0.1), np.sin(0.1)
    J, back = np.linalg.inv(unknown_start(model)[1]) + np.diag([1, 0]) / 0.09, np.array([[c, -s], [s, c]])
    for P in bound[1:]:
        J = back.T @ J @ back + np.diag([1, 0]) / 0.09
        np.testing.assert_allclose(P, np.broadcast_to(np.linalg.inv(J), P.shape), rtol=1e-6, atol=1e-12)
    alone = noise_limit(plant, dataclasses.replace(runs, plant=None), **how)
    np.testing.assert_array_equal(noise_limit(model, runs, **how).full, alone.full)
    runs = unseen_trajectories(get_system("lorenz"), 0.01, n=20, duration=20.0, seed=0)
    lorenz = noise_limit(get_system("lorenz"), runs, measurement_noise=0.5, seed=0, skip=10.0)
    assert np.median(lorenz.late) == pytest.approx(0.30, rel=0.1)
    with pytest.raises(ValueError, match="measurement_noise"):
        noise_limit(model, runs, measurement_noise=-1.0, seed=0)


def test_every_parameter_is_off_by_a_share():
    lorenz, rossler = (Motions(plant_error=0.1).plant_of(get_system(name)) for name in ("lorenz", "rossler"))
    assert lorenz.parameters == pytest.approx({"sigma": 11.0, "rho": 30.8, "beta": 8.8 / 3})
    assert Motions(plant_error=0.5).plant_of(VanDerPol(-2.0)) == VanDerPol(-3.0)
    assert show_parameters(rossler) == "a=0.22 b=0.22 c=6.27"
    with pytest.raises(ValueError, match="plant_error must be a finite number"):
        Motions(plant_error=np.inf).plant_of(VanDerPol())
    with pytest.raises(ValueError, match="two-outputs has no parameters that could be off"):
        Motions(plant_error=0.1).plant_of(TwoOutputs())


def test_a_plant_moves_from_the_models_starts_under_its_inputs_or_policy():
    model, plant = Turning(), Turning(omega=2.0, gain=3.0)
    for options in ({}, {"driven": True}, {"policy": lambda x: -x[:, :1]}):
        right, other = (
            unseen_trajectories(model, 0.05, n=6, duration=2.0, seed=3, plant=moving, **options)
            for moving in (None, plant)
        )
        assert np.array_equal(other.x[0], right.x[0])
        assert not np.allclose(other.x[1], right.x[1])
        if "policy" in options:
            np.testing.assert_allclose(other.u, 0.5 * np.clip(-other.x[:-1, :, :1], -1, 1))
        else:
            assert np.array_equal(other.u, right.u)
            assert other.u.any() == bool(options)
        for x, u, after in zip(other.x, other.u, other.x[1:]):
            np.testing.assert_allclose(np.transpose(plant.step(x.T, u.T)), after, atol=1e-12)
    assert right.plant is None
    noise = [measured(model, runs, 0.1, 0) - moving.output(runs.x) for runs, moving in ((right, model), (other, plant))]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)
