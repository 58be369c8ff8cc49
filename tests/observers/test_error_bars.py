"""The covariance of the estimate's error: interpolation, batches and files."""

import dataclasses
import pickle

import numpy as np
import pytest
from error_bars import AGES, LEVELS, covariances, with_error_bars

from observers import Artifact, ArtifactError, ErrorCovariance, Factors, KKLObserver

OPTIONS = {"process": True, "free_inverse": True}


def by_hand(error, level, age):
    """Interpolate a covariance entry by entry; `level` is a fraction of the largest level."""
    flat = error.covariance.reshape(len(LEVELS), len(AGES), -1)
    by_age = [[np.interp(level, LEVELS, column) for column in at.T] for at in flat.swapaxes(0, 1)]
    return np.reshape([np.interp(age, AGES, column) for column in np.transpose(by_age)], error.covariance.shape[2:])


def test_covariances_are_interpolated_and_stay_beyond_the_last():
    error = covariances(3)
    for level in (0.0, 0.1, 0.3, 0.7, 1.0, 2.0):
        at = error.at_level(level)
        ages = np.array([[0.0, 0.05, 0.1], [0.6, 1.0, np.inf]])
        found = at(ages)
        np.testing.assert_allclose(found, [[by_hand(error, level, age) for age in row] for row in ages], rtol=1e-12)
        np.testing.assert_array_equal(at(0.05), found[0, 1])
        np.testing.assert_array_equal(at(0.05, (4, 2)), np.broadcast_to(found[0, 1], (4, 2, 3, 3)))
        assert (np.linalg.eigvalsh(found) > 0).all()
    single = ErrorCovariance(np.zeros(1), np.zeros(1), np.eye(2)[None, None])
    for age in (0.0, np.arange(3.0), np.inf):
        np.testing.assert_array_equal(single.at_level(9.0)(age), np.broadcast_to(np.eye(2), (*np.shape(age), 2, 2)))


def test_factors_are_interpolated_by_levels_of_both_noises():
    values = np.random.default_rng(0).uniform(0.5, 2.0, (2, 3, 3))
    factors = Factors(LEVELS, AGES, values)
    np.testing.assert_allclose(factors.at_levels(0.65, 0.5), values[:, 1:].mean((0, 1)))
    np.testing.assert_array_equal(factors.at_levels(5.0, 7.0), values[1, 2])
    np.testing.assert_array_equal(Factors(LEVELS, AGES, values[:1]).at_levels(5.0, 0.7), values[0, 2])


def test_grids_and_values_that_do_not_fit():
    error, factors = covariances(2), Factors(LEVELS, AGES, np.ones((1, 3, 3)))
    for whole in (error, factors):
        for name in ("levels", "ages"):
            for wrong in ([0.0, 1.0, 1.0], [0.1, 0.3, 1.0], [0.0, 0.3, np.nan], [0.0, 0.3, np.inf], [], [[0.0]]):
                with pytest.raises(ArtifactError, match=f"the {name} of a covariance must rise from 0, got"):
                    dataclasses.replace(whole, **{name: np.array(wrong)})
            with pytest.raises(ArtifactError, match="do not fit"):
                dataclasses.replace(whole, **{name: np.zeros(1)})
    for wrong in (-1.0, 1e13):
        with pytest.raises(ArtifactError, match="factors must be positive and at most"):
            Factors(LEVELS, AGES, np.full((1, 3, 3), wrong))
    for wrong in ([[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]], np.zeros((2, 2)), np.full((2, 2), np.nan)):
        values = error.covariance.copy()
        values[1, 2] = wrong
        with pytest.raises(ArtifactError, match="must be positive definite"):
            ErrorCovariance(LEVELS, AGES, values)
    units = np.array([1e-9, 1e9])  # positive definite in any units of the states
    ErrorCovariance(LEVELS, AGES, error.covariance * np.outer(units, units))


@pytest.mark.parametrize("options", [OPTIONS, {"inputs": False, "system": "lorenz"}, {"outputs": 2}])
def test_single_and_batch_are_those_of_the_map_in_use(make_artifact, options):
    artifact, rng = with_error_bars(make_artifact(**options)), np.random.default_rng(1)
    y, u = rng.normal(size=(9, 6, artifact.ny)), rng.normal(size=(8, 6, artifact.nu))
    u[:, :3] = 0.0  # three rows of free and three of driven motion
    batch, singles = KKLObserver(artifact, 0.2), [KKLObserver(artifact, 0.2) for _ in range(6)]
    share, _ = artifact.inverse.shares(0.2)
    for k in range(9):
        batch.step(y[k], u[k - 1]) if k else batch.reset(y[k])
        for i, single in enumerate(singles):
            single.step(y[k, i], u[k - 1, i]) if k else single.reset(y[k, i])
            free = artifact.free_inverse is not None and not u[:k, i].any()
            error = (artifact.free_inverse if free else artifact.inverse).error_covariance
            expected = by_hand(error, share, k * artifact.filter.dt)
            for found in (single.covariance, batch.covariance[i]):
                np.testing.assert_allclose(found, expected, rtol=1e-12)
            np.testing.assert_allclose(single.std, np.sqrt(np.diag(expected)), rtol=1e-12)
    rows = np.arange(6) % 2 == 0
    np.testing.assert_array_equal(batch.decode_covariance(rows), batch.covariance[rows])
    along = batch.estimate_covariance(y, u if artifact.nu else None)
    assert along.shape == (9, 6, artifact.nx, artifact.nx)
    np.testing.assert_array_equal(along[-1], batch.covariance)


def test_errors_without_a_covariance_and_before_the_first_sample(make_artifact):
    plain = KKLObserver(make_artifact("van_der_pol"))
    plain.reset([0.1])
    for ask in (lambda: plain.covariance, lambda: plain.std, lambda: plain.estimate_covariance(np.zeros((3, 1)))):
        with pytest.raises(ArtifactError, match="holds no covariance; kkl-gym train"):
            ask()
    with pytest.raises(RuntimeError, match="reset"):
        _ = KKLObserver(with_error_bars(make_artifact("van_der_pol"))).covariance


@pytest.mark.parametrize("batch", [(), (4,)])
def test_the_covariance_is_that_of_the_current_estimate(make_artifact, batch, tmp_path):
    """After every operation of an observer, whose artifact was saved and read."""
    plain, rng, before = make_artifact("van_der_pol", forward=True, **OPTIONS), np.random.default_rng(3), 0.0
    with_error_bars(plain).save(tmp_path / "map.safetensors")
    observer = KKLObserver(Artifact.read(tmp_path / "map.safetensors"), 0.1)
    for change in (
        lambda y: observer.reset(y),
        lambda y: observer.step(y),  # free motion
        lambda y: observer.step(y, y),
        lambda y: observer.step(None, y),
        lambda y: setattr(observer, "measurement_noise", 0.7),
        lambda y: observer.replace(with_error_bars(plain, seed=5)),
        lambda y: observer.reset(y, np.full((*batch, 2), 0.3)),
        lambda y: observer.restart(np.atleast_2d(y)[:1], np.arange(4) < 1 if batch else np.array(True)),
    ):
        change(rng.normal(size=(*batch, 1)))
        given = observer.covariance
        assert not np.allclose(before, given, rtol=1e-3)
        before = given.copy()
        given[:] = np.nan  # a copy
        np.testing.assert_array_equal(observer.covariance, before)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(observer)).covariance, observer.covariance)
