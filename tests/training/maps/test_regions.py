"""Factors of covariances from errors whose distribution is known."""

import numpy as np
import pytest
from scipy.stats import chi2

from training.maps import regions
from training.maps.regions import Regions


@pytest.fixture
def one_level(monkeypatch):
    monkeypatch.setattr(regions, "LEVELS", (0.0,))
    return Regions(np.array([0, 5]), 20, 2)


def found(where, distance, **options):
    return where.factors([distance], np.ones(distance.shape, dtype=bool), **options)


def drawn(where, scale=1.0, outliers=0.0):
    """Squared distances of Gaussian errors whose covariance is said too small by a factor, some of them far off."""
    rng = np.random.default_rng(0)
    distance = scale * rng.chisquare(where.nx, (len(where.ages), 20_000))
    return np.where(rng.random(distance.shape) < outliers, 50.0 * distance, distance)


def test_gaussian_errors_say_what_covariances_lack(one_level):
    for options in ({}, {"lenient": True}):
        np.testing.assert_allclose(found(one_level, drawn(one_level, 3.0), **options), 3.0, rtol=0.02)


def test_long_tails_may_widen_regions_to_92_percent(one_level):
    distance = drawn(one_level, outliers=0.02)
    strict, lenient = found(one_level, distance), found(one_level, distance, lenient=True)
    edge = chi2.ppf(0.9, one_level.nx)
    assert np.mean(distance / strict[0, -1] < edge) == pytest.approx(0.9, abs=0.005)
    assert np.mean(distance / lenient[0, -1] < edge) == pytest.approx(0.92, abs=0.005)


def test_leniency_goes_no_farther_than_the_mean_asks(one_level):
    distance = drawn(one_level, outliers=0.002)
    lenient = found(one_level, distance, lenient=True)
    assert (found(one_level, distance) < lenient).all()
    assert np.mean(distance) / lenient[0, -1] == pytest.approx(one_level.nx, rel=0.03)


def test_short_tails_leave_the_factor(one_level):
    distance = np.minimum(drawn(one_level), chi2.ppf(0.95, one_level.nx))
    np.testing.assert_array_equal(found(one_level, distance, lenient=True), found(one_level, distance))
