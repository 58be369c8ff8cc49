"""Tracking observers of an environment: training in one call, known starts, and refits."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import training
from kkl_gym import KKLObservation, KKLVectorObservation
from observers import Artifact
from training import KKLTrainingCallback
from training.rollouts import callback

FIT = {"members": 1, "inverse_steps": 50, "flow_steps": 50, "width": 8, "samples": 10, "windows": 500, "batch": 128}
LEARN = {"env_id": "Pendulum-v1", "measured": [0, 1], "steps": 900, **FIT}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pendulum")
    training.learn(**LEARN, hidden=[0, 1, 2], out=folder)
    return folder / "Pendulum-v1.safetensors"


def agent(path, n, steps):
    env = make_vec_env(lambda: KKLObservation(gym.make("Pendulum-v1"), path), n, seed=0)
    return PPO("MlpPolicy", env, seed=0, n_steps=steps, batch_size=n * steps, n_epochs=1, device="cpu")


def test_observers_track_if_all_measured_signals_are_hidden_signals_too(path, tmp_path, monkeypatch):
    np.testing.assert_allclose(Artifact.read(path).C, np.eye(2, 3), atol=1e-6)
    env = KKLObservation(gym.make("Pendulum-v1"), path, measurement_noise=0.05, uncertainty=True)
    obs, info = env.reset(seed=0)
    assert obs.shape == (2 + 3 + 3,)  # y, x_hat, and standard deviations
    np.testing.assert_allclose(obs[5:], np.sqrt(np.diag(info["x_cov"])), rtol=1e-6)
    monkeypatch.chdir(tmp_path)
    for options in ({"hidden": [0, 2]}, {"hidden": [0, 1, 2], "tracking": False}):
        alone = training.learn(**LEARN | options)
        assert alone.motion is None
        assert alone.inverse.error_covariance is not None
    assert not list(tmp_path.iterdir())  # nothing is written without a folder


def test_known_starts_in_environments(path):
    env = gym.make("Pendulum-v1")
    rows = gym.make_vec("Pendulum-v1", 3, vectorization_mode="sync")
    for known in (KKLObservation(env, path, known_start=True), KKLVectorObservation(rows, path, known_start=True)):
        _, info = known.reset(seed=0)
        np.testing.assert_allclose(info["x_hat"], info["x"], rtol=1e-6)
    blanked = gym.wrappers.TransformObservation(env, lambda obs: obs[:2], gym.spaces.Box(-1.0, 1.0, (2,)))
    with pytest.raises(ValueError, match=r"does not show obs\[0\], obs\[1\], obs\[2\] at its reset"):
        KKLObservation(blanked, path, known_start=True).reset()


def test_a_refit_without_enough_held_out_is_left_out(path):
    model = agent(path, 1, 240)  # 200 steps for training, 40 held out
    with pytest.warns(UserWarning, match="the observer in use stays: too few steps are held out"):
        model.learn(480, KKLTrainingCallback(240))


def test_a_refit_learns_the_flow_again(path, monkeypatch):
    first, refits, errors = Artifact.read(path), [], iter([1.0, 0.5])  # of the old and the new observer
    monkeypatch.setattr(callback, "recorded_errors", lambda *_, **__: {"x": next(errors)})
    model = agent(path, 4, 64)
    model.learn(1300, KKLTrainingCallback(1200, on_refit=refits.append))
    (refit,) = refits
    assert refit.taken
    assert (refit.before, refit.error) == (1.0, 0.5)
    assert refit.artifact.inverse.error_covariance is not None
    assert refit.artifact.motion.x_offset[2] != first.motion.x_offset[2]  # fitted to other rollouts
    in_use = [observer.artifact.motion.x_offset[2] for observer in model.get_env().get_attr("observer")]
    assert in_use == [refit.artifact.motion.x_offset[2]] * 4
