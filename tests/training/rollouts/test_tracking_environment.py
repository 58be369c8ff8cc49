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
MEASURED, ALL = [0, 1], [0, 1, 2]


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
    training.learn("Pendulum-v1", measured=MEASURED, hidden=ALL, steps=900, tracking=True, out=folder, **FIT)
    return folder / "Pendulum-v1.safetensors"


def agent(path, n, steps):
    env = make_vec_env(lambda: KKLObservation(gym.make("Pendulum-v1"), path), n, seed=0)
    return PPO("MlpPolicy", env, seed=0, n_steps=steps, batch_size=n * steps, n_epochs=1, device="cpu")


def test_one_call_makes_it(path):
    np.testing.assert_allclose(Artifact.read(path).C, np.eye(2, 3), atol=1e-6)
    env = KKLObservation(gym.make("Pendulum-v1"), path, measurement_noise=0.05, uncertainty=True)
    obs, info = env.reset(seed=0)
    assert obs.shape == (2 + 3 + 3,)  # y, x_hat, and standard deviations
    np.testing.assert_allclose(obs[5:], np.sqrt(np.diag(info["x_cov"])), rtol=1e-6)


def test_a_start_that_is_known(path):
    env = gym.make("Pendulum-v1")
    rows = gym.make_vec("Pendulum-v1", 3, vectorization_mode="sync")
    for known in (KKLObservation(env, path, known_start=True), KKLVectorObservation(rows, path, known_start=True)):
        _, info = known.reset(seed=0)
        np.testing.assert_allclose(info["x_hat"], info["x"], rtol=1e-6)
    blanked = gym.wrappers.TransformObservation(env, lambda obs: obs[:2], gym.spaces.Box(-1.0, 1.0, (2,)))
    with pytest.raises(ValueError, match=r"does not show obs\[0\], obs\[1\], obs\[2\] at its reset"):
        KKLObservation(blanked, path, known_start=True).reset()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"tracking": "no"}, "tracking must be"),
        ({"held_out": 0.0}, "held_out must be positive"),
        ({"arbitrary_zero": ("obs[0]",)}, "cannot do without its zero"),
        ({"env_id": "Pendulum-v1", "steps": 150}, "too few to calibrate error bars on"),
        ({"env_id": "Pendulum-v1", "hidden": [0, 2]}, r"obs\[1\] cannot be told as a sum of obs\[0\], obs\[2\]"),
    ],
)
def test_what_is_refused_before_anything_is_learned(options, says):
    asked = {"env_id": "NoSuch-v0", "measured": MEASURED, "hidden": ALL, "steps": 600, "tracking": True, **FIT}
    with pytest.raises(ValueError, match=says):
        training.learn(**asked | options)


def test_a_refit_without_enough_held_out_is_left_out(path):
    model = agent(path, 1, 220)
    with pytest.warns(UserWarning, match=r"the observer in use stays: what was held out has \d+ samples"):
        model.learn(440, KKLTrainingCallback(220, inverse_steps=20))
    with pytest.raises(ValueError, match="held_out must be positive"):
        model.learn(10, KKLTrainingCallback(220, held_out=0.0))


def test_an_observer_is_taught_again(path, monkeypatch):
    first, told, errors = Artifact.read(path), [], iter([0.5, 1.0])  # of the new one, and of the old one
    monkeypatch.setattr(
        callback, "recorded_errors", lambda *_, **__: RecordedErrors({"moves": next(errors), "rests": np.nan}, 0.0, 1.0)
    )
    model = agent(path, 4, 64)
    model.learn(1300, KKLTrainingCallback(1200, on_refit=told.append, inverse_steps=50))
    (refit,) = told
    assert refit.taken
    assert refit.artifact.inverse.spread is not None
    assert refit.artifact.flow.low[2] != first.flow.low[2]  # from other rollouts
    assert (refit.before, refit.error) == (1.0, 0.5)
    in_use = [observer.artifact.flow.low[2] for observer in model.get_env().get_attr("observer")]
    assert in_use == [refit.artifact.flow.low[2]] * 4
