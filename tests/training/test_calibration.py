"""Covariances, factors and limits against closed forms: a linear system with an exact T_inv."""

import dataclasses

import numpy as np
import pytest
from linear_system import Oscillator, TwoOutputs, exact_observer
from scipy.stats import chi2
from tracking import plain_observer

from observers import MLP, ArtifactError, KKLObserver, Motion
from training import SimulatedSource, calibrate
from training.calibration import chi_square, rare, squared_distance
from training.config import settings_of
from training.evaluation.coverage import REGIONS, coverage
from training.evaluation.errors import unseen_trajectories
from training.maps.coordinates import noise_covariance

DT, DISTURBED = 0.05, 0.5


class Slow(Oscillator):
    name = "oscillator"
    dt = DT
    pace = 1.0
    process_noise = 0.0


class Disturbed(Slow):
    name = "oscillator"
    process_noise = DISTURBED


def of_process_noise(artifact):
    """Add the feature process noise to the observer, which ignores it."""
    inverse = artifact.inverse
    (weight,), biases = inverse.mlp.weights, inverse.mlp.biases
    inverse = dataclasses.replace(
        inverse,
        mlp=MLP([np.insert(weight, 4, 0.0, axis=1)], biases, "tanh"),
        features=("z_y", "measurement_noise", "process_noise", "age"),
        process_noise_unit=0.1,
        process_noise_max=DISTURBED,
    )
    return dataclasses.replace(artifact, inverse=inverse)


def calibrated(system, artifact):
    artifact = dataclasses.replace(artifact, training={**artifact.training, "inputs": False, "runs": 600})
    source = SimulatedSource(system, settings_of(artifact.training))
    return calibrate(artifact, source, motion=Motion(**source.tracking(), equations=source.equations()))


@pytest.fixture(scope="module")
def tracking():
    return calibrated(Disturbed(), of_process_noise(plain_observer()))


@pytest.fixture(scope="module")
def quiet():
    """The calibrated observer without process noise."""
    return calibrated(Slow(), plain_observer())


def test_the_covariance_of_t_inv_is_that_of_noise_and_of_the_transient(quiet):
    found = quiet.inverse.error_covariance
    linear, L = exact_observer(DT).filter, exact_observer(DT).inverse.mlp.weights[0]
    M, C = np.linalg.pinv(L), np.array([[1.0, 0.0]])
    ages = np.round(found.ages / DT).astype(int)
    noise = L @ noise_covariance(linear, ages)[:, 0] @ L.T
    moved = np.array([np.linalg.matrix_power(linear.transition, age) for age in ages])
    left = L @ moved @ (linear.equilibrium @ C - M)  # transient of the start; start variances 2/3, as a third lie in 2X
    settled, expected = ages >= 60, noise + left @ left.mT * 2 / 3
    size = np.sqrt(np.einsum("tii,tjj->tij", expected, expected))[settled]
    np.testing.assert_allclose(found.covariance[-1, settled] / size, expected[settled] / size, atol=0.15)
    first = (left @ left.mT)[:2].mean(0)  # ages 0 and 1 belong to the first knot
    assert ages[:2].tolist() == [0, 1]
    table = found.covariance[0, 0]
    np.testing.assert_allclose(table / table.trace(), first / first.trace(), atol=0.05)


def test_factors_of_an_exact_kalman_filter_are_about_one(tracking):
    _, disturbed = tracking.motion.factors.factors
    late = tracking.motion.factors.ages >= 1.0
    np.testing.assert_allclose(disturbed[2:, late], 1.0, atol=0.25)
    np.testing.assert_allclose(np.mean(disturbed[2:, late]), 1.0, atol=0.07)


@pytest.mark.parametrize("alone", [False, True])
def test_confidence_regions_on_new_runs(tracking, quiet, alone):
    system, artifact = (Slow(), dataclasses.replace(quiet, motion=None)) if alone else (Disturbed(), tracking)
    noise = system.process_noise
    runs = unseen_trajectories(system, DT, n=600, duration=20.0, seed=7, process_noise=noise)
    for level in (0.1, 0.7):
        spans = (slice(20, 22), slice(100, None))
        early, late = coverage(artifact, system, runs, measurement_noise=level, seed=7, spans=spans)
        assert late["90"] == pytest.approx(90, abs=5 if alone else 3)
        # 3 standard deviations of 600 runs are 0.037. Starts beyond X, which use T_inv's covariance, are less accurate.
        assert 85 < early["90"] < (97 if alone else 95)
        assert all(late[name] == pytest.approx(100 * share, abs=10 if alone else 7) for name, share in REGIONS.items())


def test_a_second_calibration_finds_the_same_factors(tracking):
    again = calibrate(tracking, Disturbed()).motion.factors.factors
    np.testing.assert_array_equal(again, tracking.motion.factors.factors)


def ever_above(artifact, system, level, fault=lambda y: y, n=400, duration=20.0):
    """A boolean for each of `n` new runs: whether its score raises an alarm."""
    rng = np.random.default_rng(11)
    runs = unseen_trajectories(system, DT, n=n, duration=duration, seed=3, process_noise=system.process_noise)
    y = fault(system.output(runs.x) + level * rng.standard_normal((*runs.x.shape[:2], system.ny)))
    observer = KKLObserver(artifact, level, monitor=True)
    observer.reset(y[0])
    seen = np.zeros(n, dtype=bool)
    for row in y[1:]:
        observer.advance(row)
        seen |= observer.score > 1
    return seen


def test_false_alarms_are_as_frequent_as_was_asked(tracking):
    limits = tracking.limits
    assert (np.diff(limits.mean[1:, 0]) > 0).all()  # limits grow with the noise
    assert limits.low[0] == 0.0
    assert limits.low[-1] < limits.levels[-1] == 1.0 < limits.high[-1]  # around the variance of the noise
    for level in (0.2, 1.0):
        assert ever_above(tracking, Disturbed(), level).mean() < 0.03  # the nominal rate is 0.01
    often = calibrate(tracking, Disturbed(), false_alarms=0.3)
    assert 0.05 < ever_above(often, Disturbed(), 0.2).mean() < 0.4


FAULTS = {
    "bias": lambda y: y + 0.4,
    "drop-out": lambda y: 0.0 * y,
    "freeze": lambda y: np.broadcast_to(y[:1], y.shape),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_raise_the_score(fault, quiet):
    """For T_inv alone, since a tracker may follow a faulty sensor."""
    alone = calibrate(dataclasses.replace(quiet, motion=None), Slow())

    def happens(y, at=300):
        return np.concatenate([y[:at], FAULTS[fault](y[at:])])

    seen = ever_above(alone, Slow(), 0.1, happens, n=50, duration=22.0)
    assert seen.mean() >= 0.9  # within 7 s after the fault


def test_limits_of_outputs_with_levels_of_their_own():
    class Quiet(TwoOutputs):
        name = "two-outputs"
        dt = DT
        pace = 1.0
        process_noise = 0.0
        measurement_noise = (0.1, 1.0)

    artifact = exact_observer(C=np.eye(2), name=Quiet.name)
    training = {"pipeline": "input-aware", "eigenvalues": [-1.0], "dt": DT, "measurement_noise_max": (0.2, 2.0)}
    artifact = dataclasses.replace(artifact, measurement_noise=(0.1, 1.0), training={**training, "inputs": False})
    found = calibrate(artifact, SimulatedSource(Quiet(), settings_of(artifact.training, runs=200)))
    assert found.inverse.error_covariance is None  # the map has no feature for the level
    limits = found.limits
    assert limits.mean.shape == (6, 2)
    np.testing.assert_allclose(limits.levels[[0, -1]], [[0.0, 0.0], [0.2, 2.0]])
    np.testing.assert_allclose(limits.levels[:, 1], 10 * limits.levels[:, 0])
    assert (limits.low[-1] < limits.levels[-1] ** 2).all()
    assert (limits.levels[-1] ** 2 < limits.high[-1]).all()
    for levels in ((0.1, 1.0), (0.02, 1.0), (0.2, 0.1)):
        assert ever_above(found, Quiet(), levels, n=200).mean() < 0.04  # 8 of 200 would be improbable


def test_a_system_is_a_source_too_if_the_observer_has_settings_of_its_training():
    artifact = plain_observer()
    artifact = dataclasses.replace(artifact, training={**artifact.training, "inputs": False, "runs": 100})
    assert calibrate(artifact, Slow(), false_alarms=0.5).limits.false_alarms == 0.5
    with pytest.raises(ValueError, match="holds no settings of its training"):
        calibrate(dataclasses.replace(artifact, training={}), Slow())
    with pytest.raises(ValueError, match=r"false_alarms must lie between 0 and 1, got 0\.0"):
        calibrate(artifact, Slow(), false_alarms=0.0)
    with pytest.raises(ValueError, match=r"source has .* = \(2, 1, 1\), but the observer has \(2, 1, 0\)"):
        calibrate(artifact, SimulatedSource(Slow(), settings_of(plain_observer().training)))
    with pytest.raises(ArtifactError, match="system"):
        calibrate(artifact, type("Steep", (Slow,), {"name": "steep"})())


def test_limits_stay_finite_where_most_motions_say_nothing():
    extremes = np.zeros((100, 1))
    extremes[:20] = 3.0
    assert rare(extremes, 1e-3) == pytest.approx(30.0)
    assert 0 < rare(np.zeros((100, 1)), 1e-3) < 1e-300
    gumbel = np.random.default_rng(0).gumbel(size=(20_000, 1))
    assert np.mean(np.exp(gumbel) > rare(np.exp(gumbel), 0.01)) == pytest.approx(0.01, abs=0.003)


def test_a_kalman_filter_is_consistent_on_a_linear_system():
    system = Oscillator()
    trajectories = unseen_trajectories(system, 0.05, n=600, duration=15.0, seed=2, process_noise=0.2)
    how = {"measurement_noise": 0.5, "seed": 2, "spans": (slice(-1, None),)}
    (found,) = coverage(None, system, trajectories, **how)
    for name, share in REGIONS.items():
        limit = 3.5 * np.sqrt(share * (1 - share) / 600)
        for region in (name, *(f"{name} {state}" for state in system.state_names)):
            assert found[region] / 100 == pytest.approx(share, abs=limit)
    assert found["nees_low"] < found["nees"] < found["nees_high"]
    assert found["nees_low"] < 2.0 < found["nees_high"]
    # A filter that assumes too little process noise is overconfident.
    half = dataclasses.replace(trajectories, process_noise=0.01)
    (wrong,) = coverage(None, system, half, **how)
    assert wrong["nees"] > found["nees_high"]
    assert wrong["90"] < 80


def test_distances_do_not_depend_on_units():
    rng = np.random.default_rng(0)
    root, error, units = rng.normal(size=(5, 3, 3)), rng.normal(size=(5, 3)), np.array([1e-9, 1.0, 1e9])
    covariance = root @ root.mT
    expected = [e @ np.linalg.inv(P) @ e for e, P in zip(error, covariance, strict=True)]
    np.testing.assert_allclose(squared_distance(error, covariance), expected)
    np.testing.assert_allclose(squared_distance(error * units, covariance * np.outer(units, units)), expected)
    shares = [0.1, 0.5, 0.9, 0.99]
    for degrees in (1, 2, 7, 400):
        np.testing.assert_allclose(chi_square(shares, degrees), chi2.ppf(shares, degrees))
