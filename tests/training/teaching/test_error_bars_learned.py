"""Learned error bars where they are known: on a linear system."""

import dataclasses

import numpy as np
import pytest
from linear_system import Oscillator, exact_observer
from scipy.stats import chi2

from observers import MLP, KKLObserver
from training.evaluation.coverage import REGIONS, coverage, kalman_coverage
from training.evaluation.errors import unseen_trajectories
from training.filter_noise import stationary_covariance
from training.maps.regions import chi_square, squared_distance
from training.teaching.errorbars import learn_error_bars


class Noiseless(Oscillator):
    """Process noise, which the exact observer follows slowly, is not what is tested here."""

    name = "oscillator"
    process_noise = 0.0


def told_observer():
    """The exact observer as a map that is told measurement noise and age, of which it makes nothing."""
    exact = exact_observer()
    weight = np.hstack([exact.inverse.mlp.weights[0], np.zeros((2, 2))])
    inverse = dataclasses.replace(
        exact.inverse,
        mlp=MLP([weight], [np.zeros(2)], "tanh"),
        features=("z_y", "measurement_noise", "age"),
        measurement_noise_unit=0.02,
        measurement_noise_max=1.0,
        age_unit=0.25,
        age_max=7.0,
    )
    training = {
        "pipeline": "input-aware",
        "eigenvalues": [-1.0, -2.5, -4.0],
        "dt": 0.05,
        "duration": 20.0,
        "batch": 512,
    }
    return dataclasses.replace(exact, inverse=inverse, training=training)


@pytest.fixture(scope="module")
def learned():
    return learn_error_bars(told_observer(), Noiseless(), steps=1500, trajectories=200)


def test_settled_covariance_is_the_stationary_one(learned):
    weight = learned.inverse.mlp.weights[0][:, :3]
    noise = weight @ stationary_covariance(learned.filter)[0] @ weight.T
    for level in (0.2, 1.0):
        observer = KKLObserver(learned, level)
        trajectories = unseen_trajectories(Noiseless(), 0.05, n=40, duration=20.0, seed=3)
        y = trajectories.x[..., :1] + level * np.random.default_rng(0).normal(size=(401, 40, 1))
        found = observer.estimate_covariance(y)[200:].mean((0, 1))
        size = level * np.sqrt(np.diag(noise))
        np.testing.assert_allclose(found / np.outer(size, size), noise * level**2 / np.outer(size, size), atol=0.2)


def test_estimates_stay_as_they_are(learned):
    before, y = told_observer(), np.random.default_rng(1).normal(size=(30, 4, 1))
    np.testing.assert_array_equal(KKLObserver(before, 0.3).estimate(y), KKLObserver(learned, 0.3).estimate(y))
    assert learned.free_inverse is None


@pytest.mark.parametrize("level", [0.1, 0.7])
def test_regions_hold_what_they_should(learned, level):
    system = Noiseless()
    trajectories = unseen_trajectories(system, 0.05, n=600, duration=12.0, seed=7)
    early, late = coverage(
        learned, system, trajectories, measurement_noise=level, seed=7, spans=(slice(20, 21), slice(-1, None))
    )
    for found in (early, late):
        assert found.joint[1] == pytest.approx(0.9, abs=0.05)  # of 600, three standard deviations are 0.037
    np.testing.assert_allclose(late.said, late.rms, rtol=0.15)
    np.testing.assert_allclose(late.joint, REGIONS, atol=0.06)
    np.testing.assert_allclose(late.states, np.tile(np.array(REGIONS)[:, None], (1, 2)), atol=0.07)


def test_a_kalman_filter_is_consistent_on_a_linear_system():
    system = Oscillator()
    trajectories = unseen_trajectories(system, 0.05, n=600, duration=15.0, seed=2, process_noise=0.2)
    how = {"measurement_noise": 0.5, "seed": 2, "spans": (slice(-1, None),)}
    (found,) = kalman_coverage(system, trajectories, 0.05, **how)
    limits = 3.5 * np.sqrt(np.array(REGIONS) * (1 - np.array(REGIONS)) / 600)
    assert (abs(found.joint - REGIONS) < limits).all()
    assert (abs(found.states - np.array(REGIONS)[:, None]) < limits[:, None]).all()
    assert found.limits[0] < found.nees < found.limits[1]
    assert found.limits[0] < 2.0 < found.limits[1]
    # One that takes the noise for half of what it is believes too much.
    half = dataclasses.replace(trajectories, process_noise=0.01)
    (wrong,) = kalman_coverage(system, half, 0.05, **how)
    assert wrong.nees > found.limits[1]
    assert wrong.joint[1] < 0.8


def test_distances_do_not_depend_on_units():
    rng = np.random.default_rng(0)
    root, error, units = rng.normal(size=(5, 3, 3)), rng.normal(size=(5, 3)), np.array([1e-9, 1.0, 1e9])
    covariance = root @ root.mT
    expected = [e @ np.linalg.inv(P) @ e for e, P in zip(error, covariance, strict=True)]
    np.testing.assert_allclose(squared_distance(error, covariance), expected)
    np.testing.assert_allclose(squared_distance(error * units, covariance * np.outer(units, units)), expected)


def test_what_cannot_be_learned():
    system = Noiseless()
    with pytest.raises(ValueError, match="told measurement noise and age, this one is told z_y"):
        learn_error_bars(exact_observer(), system)
    with pytest.raises(ValueError, match="does not say how it was trained"):
        learn_error_bars(dataclasses.replace(told_observer(), training={}), system)
    for wrong in ({"steps": 0}, {"trajectories": 99}, {"seed": -1}):
        with pytest.raises(ValueError, match="need a step"):
            learn_error_bars(told_observer(), system, **wrong)


def test_quantiles_are_those_of_scipy():
    shares = [0.1, 0.5, 0.9, 0.99]
    for degrees in (1, 2, 7, 400):
        np.testing.assert_allclose(chi_square(shares, degrees), chi2.ppf(shares, degrees))
