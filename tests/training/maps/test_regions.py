"""Factors of covariances from errors whose distribution is known."""

import numpy as np
import pytest
from scipy.stats import chi2

from training.maps import regions
from training.maps.regions import Errors, Regions, squared_distance, usual_mean


@pytest.fixture
def one_level(monkeypatch):
    monkeypatch.setattr(regions, "LEVELS", (0.0,))
    return Regions(np.array([0, 5]), 20, 2)


def found(where, distance):
    return where.factors([distance], np.ones(distance.shape, dtype=bool))


def doubted(where, errors):
    return where.factors_and_doubts([errors], np.ones(errors.error.shape[:2], dtype=bool))


def gaussian(where, scale=1.0, outliers=0.0, thin=1.0):
    """Errors whose covariance is said too small by a factor, some of them far off; all, along a diagonal and across."""
    rng = np.random.default_rng(0)
    shape = (len(where.ages), 8_000)
    root = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2) * np.sqrt([1.0, thin])
    error = np.sqrt(scale) * rng.standard_normal((*shape, 2)) @ root.T
    error[rng.random(shape) < outliers] *= np.sqrt(50.0)
    P = np.broadcast_to(root @ root.T, (*shape, 2, 2))
    return Errors(error, P, P * np.eye(2))


def test_gaussian_errors_say_what_covariances_lack(one_level):
    errors = gaussian(one_level, 3.0)
    factors, doubts = doubted(one_level, errors)
    np.testing.assert_allclose(factors, 3.0, rtol=0.03)
    np.testing.assert_allclose(found(one_level, squared_distance(errors.error, errors.covariance)), 3.0, rtol=0.03)
    assert not doubts.any()


def test_long_tails_may_widen_regions_to_91_percent(one_level):
    errors = gaussian(one_level, outliers=0.02)
    distance = squared_distance(errors.error, errors.covariance)
    strict, lenient = found(one_level, distance), doubted(one_level, errors)[0]
    edge = chi2.ppf(0.9, one_level.nx)
    assert np.mean(distance / strict[0, -1] < edge) == pytest.approx(0.9, abs=0.005)
    assert np.mean(distance / lenient[0, -1] < edge) == pytest.approx(0.91, abs=0.005)


def test_a_few_motions_that_are_lost_count_for_little(one_level):
    """One in five hundred, all along: most tests of a hundred motions would have none of them."""
    errors = gaussian(one_level)
    before, _ = doubted(one_level, errors)
    errors.error[:, ::500] *= np.sqrt(1000.0)
    distance = squared_distance(errors.error, errors.covariance)
    assert distance.mean() > 2.5 * one_level.nx
    np.testing.assert_allclose(doubted(one_level, errors)[0], before, rtol=0.01)


def test_the_usual_mean_is_the_median_over_hundreds_of_motions():
    motion = np.tile(np.arange(300), 4)
    value = np.where(motion % 3 == 2, 90.0, motion % 3 + 1.0)  # as motions are shared out among three groups
    assert usual_mean(value, motion) == 2.0
    assert usual_mean(value, 3 * motion) == 2.0  # whatever they are called
    few = motion < 199
    assert usual_mean(value[few], motion[few]) == pytest.approx(value[few].mean())


def test_what_goes_together_less_than_is_said_is_doubted(one_level):
    """A covariance that is thin, of errors that are not: now and then they are far off across it."""
    errors = gaussian(one_level, thin=1e-4)
    rng = np.random.default_rng(1)
    apart = rng.random(errors.error.shape[:2]) < 0.03
    errors.error[apart] = rng.standard_normal((apart.sum(), one_level.nx))
    factors, doubts = doubted(one_level, errors)
    assert (doubts > 0).all()
    certain = found(one_level, squared_distance(errors.error, errors.covariance))
    mixed = errors.covariance + doubts[0, -1] * (errors.in_doubt - errors.covariance)
    before, after = (
        np.mean(squared_distance(errors.error, covariance)) / factor
        for covariance, factor in ((errors.covariance, certain[0, -1]), (mixed, factors[0, -1]))
    )
    assert before > 10 * one_level.nx
    assert after < 3 * one_level.nx
    assert np.mean(squared_distance(errors.error, mixed) / factors[0, -1] < chi2.ppf(0.9, 2)) == pytest.approx(
        0.91, abs=0.015
    )


def test_errors_of_too_few_motions_are_those_of_neighbours(one_level):
    errors = gaussian(one_level, 3.0)
    group = np.ones(errors.error.shape[:2], dtype=bool)
    group[one_level.ages < 3] = False  # those about the first knot
    factors, _ = one_level.factors_and_doubts([errors], group)
    np.testing.assert_array_equal(factors[0, 0], factors[0, 1])
    with pytest.raises(ValueError, match="hardly any motion"):
        one_level.factors_and_doubts([errors], np.zeros_like(group))
