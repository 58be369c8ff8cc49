"""Refits of observers to an agent's own episodes."""

import dataclasses
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import training
from kkl_gym import ActionRepeat, KKLObservation, KKLVectorObservation
from observers import Artifact
from training import KKLTrainingCallback
from training.agents import SB3VecEnv
from training.records import Record, Signals
from training.rollouts import callback as module

TINY = {"width": 16, "samples": 10, "windows": 500, "batch": 128}
NET = {"net_arch": [8]}


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    """An observer trained with few random steps and few batches."""
    folder, few = tmp_path_factory.mktemp("observer"), {"steps": 400, "members": 1, "inverse_steps": 20}
    training.learn("Pendulum-v1", measured=[0, 1], hidden=[2], out=folder, **few, **TINY)
    return folder / "Pendulum-v1.safetensors"


def wrapped(env_id, path, **kwargs):
    return KKLObservation(gym.make(env_id, **kwargs), path)


def vector(env_id, path, n=4, of=DummyVecEnv, **kwargs):
    return make_vec_env(partial(wrapped, env_id, str(path), **kwargs), n, seed=0, vec_env_cls=of)


def ppo(env, steps=64, **policy):
    batch = steps * getattr(env, "num_envs", 1)
    options = {"n_steps": steps, "batch_size": batch, "n_epochs": 1, "device": "cpu"}
    return PPO("MlpPolicy", env, seed=0, policy_kwargs=NET | policy, **options)


def in_use(env):
    return [observer.artifact for observer in env.get_attr("observer")]


def test_a_refit_lowers_the_error(pendulum, tmp_path, capsys):
    results, path = [], tmp_path / "newer.safetensors"
    env = vector("Pendulum-v1", pendulum)
    first = in_use(env)[0]
    options = {"path": path, "on_refit": results.append, "verbose": 1}
    refits = KKLTrainingCallback(1000, **options, inverse_steps=200, width=32)
    refits.init_callback(model := ppo(VecNormalize(env, norm_reward=False)))
    assert refits.artifact is first
    model.learn(2100, refits)
    assert in_use(env) == [refits.artifact] * 4
    assert [refit.steps for refit in results] == [1024, 2048]
    assert results[0].taken
    last = [refit for refit in results if refit.taken][-1]  # a second refit may be worse, and is then dropped
    assert last.error < 0.4 * results[0].before
    assert results[-1].artifact is last.artifact is refits.artifact
    assert refits.artifact.training["held_out_errors"]["obs[2]"] == pytest.approx(last.error)
    assert refits.artifact.training["eigenvalues"] == tuple(first.training["eigenvalues"])
    assert Artifact.read(path).training["held_out_errors"] == refits.artifact.training["held_out_errors"]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert "refitted the observer at step 1024" in lines[0]


def test_pieces_are_longer_than_the_settling_time_of_a_slow_filter(tmp_path):
    """The filter settles after 345 steps; if episodes are shorter, a warning gives the reason for a missing refit."""
    few, results = {"steps": 1000, "members": 1, "inverse_steps": 20}, []
    long = {"eigenvalues": (-0.4, -4.0, -20.0), "env_kwargs": {"max_episode_steps": 500}}
    training.learn("Pendulum-v1", measured=[0, 1], hidden=[2], out=tmp_path, **long, **few, **TINY)
    path, options = tmp_path / "Pendulum-v1.safetensors", {"inverse_steps": 20, "on_refit": results.append}
    with pytest.warns(UserWarning, match=r"lasts 17\.3 s, the settling time .* make episodes longer, or .*eigenvalues"):
        ppo(vector("Pendulum-v1", path), 100).learn(900, KKLTrainingCallback(800, **options))
    assert results == []
    ppo(vector("Pendulum-v1", path, max_episode_steps=500), 100).learn(2000, KKLTrainingCallback(1600, **options))
    assert [refit.steps for refit in results] == [1600]


def test_environments_in_processes_of_their_own(pendulum, asked):
    env = vector("Pendulum-v1", pendulum, n=1, of=SubprocVecEnv)
    try:
        asked.artifact = dataclasses.replace(in_use(env)[0], versions={"of": "the refit"})
        ppo(env, 100).learn(400, KKLTrainingCallback(300))
        assert in_use(env)[0].versions == {"of": "the refit"}
    finally:
        env.close()
    assert [len(record.t) for record in asked.found[0]] == [200]  # the second record is held out


@pytest.fixture
def asked(monkeypatch):
    """Collects the records of each refit; the refit itself is replaced."""
    found = []

    def train(source):
        train.random = torch.get_rng_state()
        torch.manual_seed(0)
        found.append(source.records)
        return SimpleNamespace(artifact=train.artifact)

    monkeypatch.setattr(module, "train", train)
    train.found = found
    return train


@pytest.fixture
def spied(spy, asked):
    """Makes environments of Spy; a refit returns the observer in use unchanged."""

    def make(n=1):
        env = vector("Spy-v0", spy, n)
        asked.artifact = in_use(env)[0]
        return env

    return make


def check_spied(records):
    """Assert that each input equals the action that the next sample shows."""
    for record in records:
        np.testing.assert_allclose(record.u[:-1, 0], (record.x[1:, 0] - 1.0) / 2.0, atol=1e-6)
        assert (record.y[0, 0] >= 50) == (record.x[0, 0] == -50)
        assert (record.y[1:, 0] < 50).all()
        assert np.diff(record.y[1:, 0]).tolist() == [1.0] * (len(record.t) - 2)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_actions_are_those_that_acted(spied, asked, algorithm):
    if algorithm == "ppo":
        model = ppo(VecNormalize(spied(2)), 50, log_std_init=1.5)
    else:
        noise = NormalActionNoise(np.zeros(1), np.ones(1))
        options = {"learning_starts": 20, "action_noise": noise, "train_freq": 50, "gradient_steps": 1}
        model = SAC("MlpPolicy", spied(), seed=0, policy_kwargs=dict(NET), device="cpu", **options)
    model.learn(250, KKLTrainingCallback(100))
    assert len(asked.found) == 2
    records = asked.found[-1]
    check_spied(records)
    assert len(records) == pytest.approx(0.5 * 200 / 7, abs=4)
    assert sum(record.y[0, 0] >= 50 for record in records) >= len(records) - 3  # records begin at resets
    u = np.concatenate([record.u for record in records])
    assert u.min() < -0.5
    assert u.max() > 0.5
    if algorithm == "ppo":  # actions are clipped
        assert abs(u).max() == 1.0


def test_vectors_of_gymnasium(spy, asked):
    envs = gym.make_vec(
        "Spy-v0", 3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
    )
    envs = KKLVectorObservation(envs, spy)
    new = asked.artifact = dataclasses.replace(envs.observer.artifact, measurement_noise=0.0)
    refits = KKLTrainingCallback(100)
    ppo(SB3VecEnv(envs, info_keys=("y", "u", "x", "sample")), 50).learn(200, refits)
    check_spied(asked.found[0])
    assert sum(record.y[0, 0] >= 50 for record in asked.found[0]) >= len(asked.found[0]) - 3
    assert envs.observer.artifact == refits.artifact
    assert refits.artifact.filter is new.filter
    with pytest.raises(ValueError, match=r"has no 'y', 'u', 'x', 'sample'.*info_keys"):
        ppo(SB3VecEnv(envs), 50).learn(200, KKLTrainingCallback(100))
    with pytest.raises(ValueError, match=r"observers of kkl_gym\.KKLObservation, and the environment has none"):
        ppo(SB3VecEnv(envs.env), 50).learn(200, KKLTrainingCallback(100))


def test_a_training_that_goes_on(spied, asked):
    env, after = spied(), []
    refits = KKLTrainingCallback(100, on_refit=lambda refit: after.append(torch.get_rng_state()))
    model = ppo(env, 50)
    for _ in range(5):  # each call continues the episode
        model.learn(50, refits, reset_num_timesteps=False)
    check_spied(asked.found[-1])
    assert len(asked.found) == 2
    assert torch.equal(asked.random, after[-1])  # refits do not use the agent's random numbers


def test_a_rehearsal_is_played_as_the_agent_will_act(spied, asked, monkeypatch):
    env, results = VecNormalize(spied(2)), []
    model = ppo(env, 50, log_std_init=1.5)
    refits = KKLTrainingCallback(100, keep=30, rehearsal=30, on_refit=results.append)
    predict, acted = model.predict, []

    def noted(*given, **options):
        actions, state = predict(*given, **options)
        acted.extend(np.clip(actions, -1.0, 3.0))
        return actions, state

    monkeypatch.setattr(model, "predict", noted)
    for _ in range(2):  # the second call begins new episodes
        seen = env.obs_rms.count
        model.learn(200, refits, reset_num_timesteps=False)
        assert env.obs_rms.count == seen + 202  # includes the reset, excludes the rehearsal
        assert env.training
        records = [record for record in asked.found[-1] if record.y[0, 0] >= 50]
        check_spied(records)
        played = [round(float(u), 5) for u in np.ravel(acted)]
        assert {round(float(u), 5) for record in records for u in record.u[:-1, 0] * 2 + 1} <= {*played}
    assert [refit.steps for refit in results] == [100, 230, 330, 460]
    assert len(acted) == 60


@pytest.mark.parametrize(("memory", "before", "times"), [(7.0, True, 2), (8.0, True, 0), (8.0, False, 0)])
def test_a_refit_is_judged_by_the_agents_own_episodes(spied, asked, monkeypatch, memory, before, times):
    """If no held-out episode is long enough, earlier records cause a warning instead of a refit."""
    env = spied()
    signals, column = Signals("t", ("obs[0]",), ("action[0]",), ("obs[1]",)), np.zeros((100, 1))
    long = Record("long", np.arange(100.0), *[column] * 3, signals, environment=asked.artifact.environment)
    monkeypatch.setattr(module, "settling_time", lambda linear: memory)
    with nullcontext() if times else pytest.warns(UserWarning, match="the observer in use stays"):
        ppo(env, 50).learn(150, KKLTrainingCallback(50, records=[long] * before))
    assert len(asked.found) == times


def test_episodes_from_before_must_be_of_the_plant(spied, asked):
    env = spied()
    ppo(env, 50).learn(100, KKLTrainingCallback(50, held_out=0.0))
    record = asked.found[0][0]
    for change, message in (
        ({"x": None}, "no hidden states"),
        ({"environment": {**record.environment, "id": "Other-v0"}}, "Other-v0"),
        ({"t": 1e-3 * record.t}, "do not fit dt = 1 s"),
    ):
        with pytest.raises(ValueError, match=message):
            ppo(env, 50).learn(100, KKLTrainingCallback(50, records=[dataclasses.replace(record, **change)]))


def test_a_worse_observer_is_not_taken(pendulum, asked):
    env, refits = vector("Pendulum-v1", pendulum, n=1), []
    old = in_use(env)[0]
    far = dataclasses.replace(old.inverse, x_offset=old.inverse.x_offset + 99.0)
    asked.artifact = dataclasses.replace(old, inverse=far)
    ppo(env, 100).learn(900, KKLTrainingCallback(600, on_refit=refits.append))
    assert (refits[0].taken, refits[0].error, refits[0].artifact) == (False, refits[0].before, old)
    assert "error still" in str(refits[0])
    assert in_use(env) == [old]


def test_environments_that_are_refused(pendulum, tmp_path):
    plain = dataclasses.replace(Artifact.read(pendulum), training={})
    plain.save(tmp_path / "plain.safetensors")
    env, space = gym.make("Pendulum-v1"), spaces.Box(-1.0, 1.0, (2,))
    noise = DummyVecEnv([partial(KKLObservation, gym.make("Pendulum-v1"), pendulum, measurement_noise=0.05)])
    hiding = KKLObservation(gym.wrappers.TransformObservation(env, lambda obs: obs[:2], space), pendulum)
    other = dataclasses.replace(plain, signals=plain.signals | {"hidden": ["sin(obs[2])"]})
    other.save(tmp_path / "other.safetensors")
    two = DummyVecEnv([partial(wrapped, "Pendulum-v1", pendulum)] * 2)
    two.envs[1] = wrapped("Pendulum-v1", tmp_path / "other.safetensors")
    for env, settings, message in (
        (gym.make("Pendulum-v1"), {}, r"the environment has none: wrap each environment"),
        (wrapped("Pendulum-v1", tmp_path / "plain.safetensors"), {}, "holds no settings of its training"),
        (hiding, {}, r"environment 0 has no 'x': KKLObservation gives the true obs\[2\] as 'x'"),
        (ActionRepeat(wrapped("Pendulum-v1", pendulum), 2), {}, "showed sample 4 after 2: a refit needs all samples"),
        (noise, {"measurement_noise_max": 0.01}, r"measurement_noise_max = 0\.01 is less than the noise 0\.05"),
        (wrapped("Pendulum-v1", pendulum), {"held_out": 0.0}, "held_out must be positive, got 0"),
        (two, {}, "has signals"),
        (wrapped("Pendulum-v1", pendulum), {"width": -1}, "width"),
    ):
        with pytest.raises(ValueError, match=message):
            ppo(env, 10).learn(20, KKLTrainingCallback(100, **settings))


def test_invalid_arguments_of_the_callback():
    for arguments, message in (
        ({"every": 10.5}, "every must be"),
        ({"records": ["a"]}, r"records must be a list of training\.records\.Record, got"),
        ({"path": "observer.zip"}, "path must end in"),
        ({"on_refit": 3}, "on_refit must be a function"),
        ({"eigenvalues": (-1.0,), "dt": 0.1}, "eigenvalues, dt cannot change"),
        ({"neurons": 3}, "neurons"),
    ):
        with pytest.raises(ValueError, match=message):
            KKLTrainingCallback(**arguments)
