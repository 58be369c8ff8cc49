"""The monitor: scores of residuals relative to their limits."""

import copy
import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from monitor_limits import limits
from random_artifacts import random_artifact

from kkl_gym import ENV_IDS, KKLObservation, KKLVectorObservation
from observers import ArtifactError, KKLObserver, Monitor, load


def test_running_means_by_hand():
    monitor = Monitor(limits(), 1.0, 0.01)
    rows = monitor.start(1)
    a = 1 - np.exp(-0.1)
    rng = np.random.default_rng(0)
    mean, square = 0.0, 1.0
    for k, r in enumerate(rng.normal(0.3, 1.0, 40), 1):
        rows = monitor.update(rows, np.array([[r]]), np.array([[True]]))
        mean, square = mean + a * (r - mean), square + a * (r**2 - square)
        expected = max(abs(mean) / 0.5, square / 2.1, 0.4 / square)
        assert monitor.score(rows) == pytest.approx(expected if k > 5 else 0.0)


def test_limits_between_levels_add_as_variances():
    mean, low, high = limits().at(0.5)
    assert mean == pytest.approx(np.sqrt(0.75 * 0.09 + 0.25 * 0.25))
    assert low == pytest.approx(0.1)
    assert high == pytest.approx(0.75 * 0.1 + 0.25 * 2.1)
    with pytest.raises(ValueError, match="beyond"):
        limits().at(1.01)


def watched_artifact(**options):
    return dataclasses.replace(random_artifact(**options), C=np.array([[1.0, 0.0]]), limits=limits())


def test_a_monitor_changes_no_estimate():
    artifact = watched_artifact()
    rng = np.random.default_rng(2)
    y = rng.normal(size=(20, 4, 1))
    plain, watched = KKLObserver(artifact, 0.3), KKLObserver(artifact, 0.3, monitor=True)
    assert (plain.reset(y[0]) == watched.reset(y[0])).all()
    for k in range(1, 20):
        assert (plain.step(y[k]) == watched.step(y[k])).all()
        rows = rng.random(4) < 0.5
        np.testing.assert_allclose(plain.decode(rows), watched.decode(rows), rtol=1e-5, atol=1e-5)  # rounding
    before = watched.score
    assert (plain.step(None) == watched.step(None)).all()
    assert (watched.score == before).all()  # a missing sample changes no score
    watched.decode()[:] = np.nan  # a copy
    assert np.isfinite(watched.decode()).all()
    for rows in (np.array([0, 2]), np.array([True, False])):
        with pytest.raises(ValueError, match="rows must be boolean"):
            watched.decode(rows)


def test_no_score_without_a_monitor_or_limits():
    artifact = dataclasses.replace(random_artifact(), C=np.array([[1.0, 0.0]]))
    with pytest.raises(ValueError, match="no limits"):
        KKLObserver(artifact, monitor=True)
    observer = KKLObserver(artifact)
    observer.reset(np.zeros(1))
    with pytest.raises(RuntimeError, match="monitor=True"):
        _ = observer.score
    watched = KKLObserver(dataclasses.replace(artifact, limits=limits()), monitor=True)
    with pytest.raises(RuntimeError, match="reset"):
        _ = watched.score
    with pytest.raises(ArtifactError, match="need C or h"):
        dataclasses.replace(artifact, C=None, limits=limits())
    with pytest.raises(ArtifactError, match="must have 1 outputs, got 2"):
        dataclasses.replace(artifact, limits=limits(ny=2))


def test_a_new_noise_level_restarts_the_monitor():
    artifact = watched_artifact()
    plain, watched = KKLObserver(artifact, 0.3), KKLObserver(artifact, 0.3, monitor=True)
    y = np.random.default_rng(3).normal(size=(30, 2, 1))
    for observer in (plain, watched):
        observer.reset(y[0])
        for k in range(1, 15):
            observer.step(y[k])
        observer.measurement_noise = 0.9
    assert (watched.score == 0).all()  # a new level restarts the monitor
    assert (plain.decode() == watched.decode()).all()
    for k in range(15, 30):
        assert (plain.step(y[k]) == watched.step(y[k])).all()
    assert (watched.score > 0).all()
    blind = watched_artifact(noise=False)
    observer = KKLObserver(blind, 0.5, monitor=True)
    with pytest.raises(ValueError, match="beyond"):
        observer.measurement_noise = 3.0
    assert observer.measurement_noise == 0.5


def test_copies_have_monitors_of_their_own(tmp_path):
    watched_artifact().save(tmp_path / "a.safetensors")
    observer = load(tmp_path / "a.safetensors", monitor=True)
    observer.reset(np.zeros(1))
    for _ in range(30):
        observer.step(np.ones(1))
    score, other = observer.score, copy.copy(observer)
    for _ in range(30):
        other.step(np.full(1, 5.0))
    assert other.score > score == observer.score


def test_wrappers_report_the_score(tmp_path):
    path = tmp_path / "a.safetensors"
    watched_artifact().save(path)
    rows = gym.make_vec(ENV_IDS["van_der_pol"], num_envs=2, vectorization_mode="vector_entry_point")
    many = KKLVectorObservation(rows, str(path), estimate="z", monitor=True)
    ones = [KKLObservation(gym.make(ENV_IDS["van_der_pol"]), path, estimate="z", monitor=True) for _ in range(2)]
    _, info = many.reset(seed=5)
    assert (info["score"] == 0).all()
    for i, env in enumerate(ones):
        assert env.reset(seed=5 + i)[1]["score"] == 0.0
    for _ in range(20):
        action = many.action_space.sample()
        info = many.step(action)[-1]
        single = [env.step(one)[-1] for env, one in zip(ones, action, strict=True)]
        assert info["score"] == pytest.approx(np.array([each["score"] for each in single]), rel=1e-5)
        assert all(each["score"].shape == () for each in single)
    assert (info["score"] > 0).all()
    assert info["_score"].all()
    random_artifact().save(path)
    with pytest.raises(ValueError, match="no limits"):
        KKLObservation(gym.make(ENV_IDS["van_der_pol"]), path, monitor=True)
