"""Observers of an environment that track: learned in one call, told where episodes start, and taught again."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import training
from kkl_gym import KKLObservation, KKLVectorObservation
from observers import Artifact
from training import KKLTrainingCallback
from training.recorded import errorbars, tracking
from training.recorded.errors import RecordedErrors
from training.rollouts import callback

FIT = {"members": 1, "inverse_steps": 100, "width": 16, "samples": 10, "windows": 500, "batch": 128}


@pytest.fixture(autouse=True, scope="module")
def short():
    """Few batches."""
    with pytest.MonkeyPatch.context() as patch:
        bars, track = errorbars.learn_recorded_error_bars, tracking.learn_recorded_tracking
        patch.setattr(errorbars, "learn_recorded_error_bars", partial(bars, steps=20))
        patch.setattr(tracking, "learn_recorded_tracking", partial(track, steps=200))
        patch.setattr(callback, "QUICK_ERROR_BARS", 20)
        patch.setattr(callback, "QUICK_FLOW", 200)
        yield


@pytest.fixture(scope="module")
def path(short, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pendulum")
    training.learn("Pendulum-v1", measured=[0, 1], hidden=[0, 1, 2], steps=900, tracking=True, out=folder, **FIT)
    return folder / "Pendulum-v1.safetensors"


def test_one_call_makes_it(path):
    artifact = Artifact.read(path)
    np.testing.assert_allclose(artifact.C, np.eye(2, 3), atol=1e-6)
    env = KKLObservation(gym.make("Pendulum-v1"), path, measurement_noise=0.05, uncertainty=True)
    obs, info = env.reset(seed=0)
    assert obs.shape == (2 + 3 + 3,)  # y, x_hat, and standard deviations
    np.testing.assert_allclose(obs[5:], np.sqrt(np.diag(info["x_cov"])), rtol=1e-6)


def test_a_signal_that_says_nothing_of_what_is_measured():
    with pytest.raises(ValueError, match=r"obs\[1\] cannot be told as a sum of obs\[0\], obs\[2\]"):
        training.learn("Pendulum-v1", measured=[0, 1], hidden=[0, 2], steps=600, tracking=True, **FIT)


def test_a_start_that_is_known(path):
    env = KKLObservation(gym.make("Pendulum-v1"), path, known_start=True)
    _, info = env.reset(seed=0)
    np.testing.assert_allclose(info["x_hat"], info["x"], rtol=1e-6)
    rows = KKLVectorObservation(gym.make_vec("Pendulum-v1", 3, vectorization_mode="sync"), path, known_start=True)
    _, info = rows.reset(seed=0)
    np.testing.assert_allclose(info["x_hat"], info["x"], rtol=1e-6)
    blanked = gym.wrappers.TransformObservation(
        gym.make("Pendulum-v1"), lambda obs: obs[:2], gym.spaces.Box(-1.0, 1.0, (2,))
    )
    with pytest.raises(ValueError, match=r"does not show obs\[0\], obs\[1\], obs\[2\] at its reset"):
        KKLObservation(blanked, path, known_start=True).reset()


def test_what_is_refused_before_anything_is_played():
    asked = {"measured": [0, 1], "hidden": [0, 1, 2], **FIT}
    for wrong, said in (
        ({"tracking": "no"}, "tracking must be"),
        ({"tracking": True, "held_out": 0.0}, "held_out must be positive"),
        ({"tracking": True, "arbitrary_zero": ("obs[0]",)}, "cannot do without its zero"),
    ):
        with pytest.raises(ValueError, match=said):
            training.learn("NoSuch-v0", **asked, **wrong)
    with pytest.raises(ValueError, match="too few to calibrate error bars on"):
        training.learn("Pendulum-v1", steps=150, tracking=True, **asked)


def test_a_refit_without_enough_held_out_is_left_out(path):
    env = make_vec_env(lambda: KKLObservation(gym.make("Pendulum-v1"), path), 1, seed=0)
    model = PPO("MlpPolicy", env, seed=0, n_steps=220, batch_size=220, n_epochs=1, device="cpu")
    with pytest.warns(UserWarning, match=r"the observer in use stays: what was held out has \d+ samples"):
        model.learn(440, KKLTrainingCallback(220, inverse_steps=20))
    with pytest.raises(ValueError, match="held_out must be positive"):
        model.learn(10, KKLTrainingCallback(220, held_out=0.0))


@pytest.mark.parametrize("better", [True, False])
def test_an_observer_is_taught_again(path, better, monkeypatch):
    first, told = Artifact.read(path), []
    errors = iter([0.5, 1.0] if better else [1.0, 0.5])  # of the new one, and of the old one
    monkeypatch.setattr(
        callback, "recorded_errors", lambda *_, **__: RecordedErrors({"moves": next(errors), "rests": np.nan}, 0.0, 1.0)
    )
    env = make_vec_env(lambda: KKLObservation(gym.make("Pendulum-v1"), path), 4, seed=0)
    model = PPO("MlpPolicy", env, seed=0, n_steps=64, batch_size=256, n_epochs=1, device="cpu")
    model.learn(1300, KKLTrainingCallback(1200, on_refit=told.append, inverse_steps=50))
    (refit,) = told
    assert refit.artifact.flow is not None
    assert refit.artifact.inverse.spread is not None
    assert (refit.artifact.flow.low[2] != first.flow.low[2]) == refit.taken == better  # from other rollouts
    assert (refit.before, refit.error) == ((1.0, 0.5) if better else (0.5, 0.5))
    in_use = [observer.artifact.flow.low[2] for observer in env.get_attr("observer")]
    assert [low != first.flow.low[2] for low in in_use] == [better] * 4
