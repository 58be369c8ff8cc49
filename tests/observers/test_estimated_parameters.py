"""Observers for ranges of parameters, and observers that estimate parameters and states."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from kkl_gym import KKLObservation, KKLVectorObservation
from observers import ArtifactError, KKLObserver


def records(artifact, *batch, steps=30):
    rng = np.random.default_rng(3)
    u = rng.normal(size=(steps - 1, *batch, artifact.nu))
    u[:10] = 0.0  # the map of free motion gives the first estimates
    return rng.normal(size=(steps, *batch, artifact.ny)), u


@pytest.mark.parametrize("free_inverse", [False, True])
def test_states_and_parameters_are_parts_of_one_map(make_artifact, free_inverse):
    artifact = make_artifact("lorenz", estimated=True, free_inverse=free_inverse)
    assert (artifact.nx, artifact.estimated_parameters) == (3, ("sigma", "rho", "beta"))
    whole = dataclasses.replace(artifact, parameter_ranges={}, estimated_parameters=())
    y, u = records(artifact, 4)
    both = KKLObserver(whole).estimate(y, u)
    observer = KKLObserver(artifact)
    np.testing.assert_allclose(observer.estimate(y, u), both[..., :3], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(observer.estimate_parameters(y, u), both[..., 3:], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_parameters_step_by_step(make_artifact, batch):
    observer = KKLObserver(make_artifact(estimated=True, free_inverse=True), 0.1)
    y, u = records(observer.artifact, *batch)
    along = observer.estimate_parameters(y, u)
    assert along.shape == (30, *batch, 1)
    assert observer.reset(y[0]).shape == (*batch, 2)
    for k in range(1, 30):
        assert observer.step(y[k], u[k - 1]).shape == (*batch, 2)
        np.testing.assert_allclose(observer.parameters_hat, along[k], rtol=1e-5, atol=1e-6)
    observer.measurement_noise = 0.9
    assert (observer.parameters_hat != along[-1]).all()


def test_errors_of_observers_that_estimate_no_parameters(make_artifact):
    observer = KKLObserver(make_artifact())
    with pytest.raises(RuntimeError, match="reset"):
        _ = observer.parameters_hat
    observer.reset(np.zeros(1))
    with pytest.raises(ValueError, match="--set estimate_parameters=true"):
        _ = observer.parameters_hat
    with pytest.raises(ValueError, match="estimates no parameters"):
        observer.estimate_parameters(np.zeros((3, 1)))


def test_an_observer_fits_every_plant_of_its_range(make_artifact):
    artifact = make_artifact(estimated=True)
    for mu in (3.0, 2.7, 3.0 * 1.1):
        artifact.check("van_der_pol", {"mu": mu}, dt=0.01, ny=1, nu=1)
    with pytest.raises(ArtifactError, match=r"mu within \(2.7, 3.30*\d*\), but the environment has 3.4"):
        artifact.check("van_der_pol", {"mu": 3.4}, dt=0.01, ny=1, nu=1)
    with pytest.raises(ArtifactError, match="parameter mu"):
        artifact.check("van_der_pol", {}, dt=0.01, ny=1, nu=1)


def test_invalid_ranges_of_parameters(make_artifact):
    artifact = make_artifact(estimated=True)
    for ranges in ({"mu": (3.1, 3.3)}, {"nu": (3.1, 3.3)}, {"mu": (2.0, np.nan)}, {"mu": 3.0}, [3.0], {}):
        with pytest.raises(ArtifactError, match="parameter"):
            dataclasses.replace(artifact, parameter_ranges=ranges)
    names = ("mu", "nu", "xi")
    own = {"parameters": dict.fromkeys(names, 3.0), "parameter_ranges": dict.fromkeys(names, (2, 4))}
    with pytest.raises(ArtifactError, match="must estimate states"):
        dataclasses.replace(artifact, estimated_parameters=names, **own)


def test_wrappers_show_parameters(saved):
    path = saved(system="rossler", estimated=True)
    env = KKLObservation(gym.make("KKLRossler-v0", parameters={"c": 6.0}), path)  # another plant within the map's range
    obs, info = env.reset(seed=0)
    assert (obs.shape, info["parameters_hat"].shape) == ((3,), (3,))
    *_, info = env.step([0.1])
    np.testing.assert_array_equal(info["parameters_hat"], env.observer.parameters_hat)
    envs = KKLVectorObservation(gym.make_vec("KKLRossler-v0", num_envs=4, autoreset_mode="SameStep"), path)
    _, info = envs.reset(seed=0)
    assert info["parameters_hat"].shape == (4, 3)
    alone = KKLObservation(gym.make("KKLRossler-v0"), path, estimate="z")
    assert "parameters_hat" not in alone.reset(seed=0)[1]
