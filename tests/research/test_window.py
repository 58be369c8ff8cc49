"""Estimates by a network on stacked observations, the rival of observers that is told as much."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from examples.research.environments.window import WindowEstimator
from examples.research.environments.window_fit import Stacks, learn_window
from observers import MLP
from training.agents.any_environment import learning
from training.agents.any_environment.information import Stacked, part_of, show
from training.agents.any_environment.learning import learn_to_play
from training.agents.any_environment.observing import SETTINGS, Told, wander
from training.agents.any_environment.player import Player
from training.agents.any_environment.task import HIDDEN_VELOCITIES
from training.progress import progress_bars
from training.rollouts.playing import Recorder

PENDULUM = HIDDEN_VELOCITIES["Pendulum-v1"]
NOISY = replace(PENDULUM, measurement_noise=0.3, frames=4)
CART = HIDDEN_VELOCITIES["CartPole-v1"]
NARROW = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}, "n_timesteps": 64}
SMALL = {
    "ppo": {"default": {**NARROW, "n_envs": 2, "n_steps": 16, "batch_size": 16}},
    "sac": {"default": {**NARROW, "n_envs": 2, "learning_starts": 32, "train_freq": 10, "gradient_steps": 1}},
}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setitem(SETTINGS, "inverse_steps", 300)


def wandered(task, steps=2000, seed=0):
    with progress_bars(None) as bars:
        return wander(task, steps, seed=seed, progress=bars)


def learned(task, folder, records):
    with progress_bars(None) as bars:
        return str(learn_window(task, records, folder, seed=0, progress=bars))


@pytest.mark.parametrize("task", [PENDULUM, CART], ids=["pendulum", "cart"])
def test_it_is_fitted_to_the_stacks_that_it_will_see(task):
    whole = task.make()
    recorder = Recorder(whole, **task.signals(whole.observation_space.shape[0]))
    env = Stacked(part_of(recorder, task.measured), 5)
    env.action_space.seed(0)
    seen = []
    for episode in range(3):
        seen.append(env.reset(seed=episode)[0])
        over = False
        while not over:
            stack, _, terminated, truncated, _ = env.step(env.action_space.sample())
            seen.append(stack)
            over = terminated or truncated
    records = recorder.rollouts().records()
    states = np.concatenate([record.x for record in records])
    stacks = Stacks(replace(task, frames=5), records)
    batch = stacks(torch.Generator().manual_seed(0))
    inputs = batch.inputs.numpy() * stacks.scale + stacks.mean
    x = batch.x.numpy() * stacks.x_scale + stacks.x_mean
    apart = np.abs(inputs[:, None] - np.array(seen)).max(-1)
    here = apart.argmin(1)
    np.testing.assert_allclose(apart.min(1), 0.0, atol=1e-5)
    np.testing.assert_allclose(x, states[here], atol=1e-5)
    ages = np.concatenate([np.arange(len(record.t)) for record in records])
    np.testing.assert_array_equal(batch.cell, np.minimum(ages[here], 4))


def test_an_output_has_one_noise_wherever_it_stands():
    stacks = Stacks(NOISY, wandered(NOISY, 200))
    stacks._known = stacks._known[:1]  # the first output of an episode, four times
    drawn = stacks(torch.Generator().manual_seed(0)).inputs.reshape(-1, 4, 3)
    assert (drawn == drawn[:, :1]).all()
    noise = (drawn[:, 0] - stacks._table[0]).numpy() * stacks.scale[:3]
    np.testing.assert_allclose(noise.std(0), [0.3, 0.3, 0.0], rtol=0.1)


def test_its_file_estimates_what_is_hidden(tmp_path):
    path = learned(CART, tmp_path, wandered(CART, 5000))
    env, plain = show(CART, "stacked_x_hat", path), CART.make()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about bounds that are infinite, and that the environment is wrapped
        check_env(env, skip_render_check=True)
    apart, there = [], []
    for episode in range(20):
        obs, whole = env.reset(seed=100 + episode)[0], plain.reset(seed=100 + episode)[0]
        over = False
        while not over:
            np.testing.assert_array_equal(obs[:2], whole[[0, 2]])
            action = env.action_space.sample()
            obs, _, over, *_ = env.step(action)
            whole = plain.step(action)[0]
            apart.append(obs[2:] - whole[[1, 3]])
            there.append(whole[[1, 3]])
    assert (np.std(apart, 0) < 0.05 * np.std(there, 0)).all()


def test_under_noise_it_estimates_what_is_measured_too(tmp_path):
    noisy = replace(PENDULUM, measurement_noise=0.2)
    env = show(noisy, "stacked_x_hat", learned(noisy, tmp_path, wandered(noisy, 4000)))
    seen, exact = [], []
    obs, info = env.reset(seed=7)
    for _ in range(200):
        seen.append(obs)
        exact.append(info["clean"])
        obs, _, _, _, info = env.step(env.action_space.sample())
    assert obs.shape == (3,)
    assert (np.std(np.subtract(seen, exact)[8:], 0)[:2] < 0.15).all()  # of noise of 0.2


def test_agents_learn_on_it_and_their_files_act(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "settings_of", SMALL.get)
    learn_to_play(CART, "stacked_x_hat", tmp_path, algorithm="ppo", timesteps=400)
    player = Player.read(tmp_path / "agent.safetensors")
    env = player.make()
    obs, _ = env.reset(seed=0)
    assert obs.shape == (4,)
    assert env.observation_space == Told(CART, 1).make().observation_space
    assert player.act(obs, env.action_space) in env.action_space


def estimator(task, width=24):
    network = MLP([np.zeros((1, width))], [np.zeros(1)], "tanh")
    return WindowEstimator(network, np.zeros(width), np.ones(width), WindowEstimator.made_for(task))


def test_what_is_none_or_anothers_is_refused(tmp_path):
    path = tmp_path / "window.safetensors"
    estimator(PENDULUM).save(path)
    assert show(PENDULUM, "stacked_x_hat", str(path)).observation_space.shape == (3,)
    for other, says in (
        (CART, "env_id = 'Pendulum-v1', not 'CartPole-v1'"),
        (replace(PENDULUM, measured=(1, 0)), r"measured = \[0, 1\], not \[1, 0\]"),
        (replace(PENDULUM, env_kwargs={"g": 1.0}), "env_kwargs"),
        (replace(PENDULUM, frames=12), "frames = 8, not 12"),
        (replace(PENDULUM, measurement_noise=0.1), "noisy = False, not True"),
    ):
        with pytest.raises(ValueError, match=f"another task: .*{says}"):
            show(other, "stacked_x_hat", str(path))
    estimator(PENDULUM, width=21).save(path)
    with pytest.raises(ValueError, match="makes 1 numbers of 21, and 1 of 24 are needed"):
        show(PENDULUM, "stacked_x_hat", str(path))
    with pytest.raises(ValueError, match="scale must be positive"):
        replace(estimator(PENDULUM), scale=np.zeros(24))
    with pytest.raises(ValueError, match="mean must be 24 finite numbers"):
        replace(estimator(PENDULUM), mean=np.full(24, np.nan))
    with pytest.raises(ValueError, match="needs an observer"):
        show(PENDULUM, "stacked_x_hat")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="damaged"):
        WindowEstimator.read(path)


@pytest.mark.parametrize("kind", ["x_hat", "stacked_x_hat"])
def test_where_nothing_is_hidden_nothing_is_learned(tmp_path, kind):
    with pytest.raises(ValueError, match="nothing is left to estimate"):
        learn_to_play(replace(CART, measured=(0, 1, 2, 3)), kind, tmp_path)


def test_what_is_measured_may_be_named_as_hidden_under_noise(tmp_path):
    task = replace(PENDULUM, hidden=(0, 1, 2), measurement_noise=0.1)
    assert show(task, "stacked_x_hat", learned(task, tmp_path, wandered(task))).reset()[0].shape == (3,)


@pytest.mark.parametrize(("task", "algorithm"), [(replace(CART, measurement_noise=0.02), "ppo"), (PENDULUM, "sac")])
def test_it_is_fitted_again_to_what_the_agent_does(tmp_path, monkeypatch, task, algorithm):
    fits, fitted = [], learning.learn_window

    def noted(task, records, **options):
        fits.append(sum(len(record.t) - 1 for record in records))
        return fitted(task, records, **options)

    monkeypatch.setattr(learning, "learn_window", noted)
    monkeypatch.setattr(learning, "settings_of", SMALL.get)
    learn_to_play(task, "stacked_x_hat", tmp_path, algorithm=algorithm, timesteps=4000, aggregate=2)
    # Under noise of 3,400 steps after the random ones, and 200 without exploration. Else all that was told counts too.
    expected = [1133, 2267, 3600] if task.measurement_noise else [3600 + 67, 3600 + 133, 4000]
    late = np.subtract(fits[1:], expected)  # a refit waits until the algorithm has collected
    assert (late > -5).all()
    assert (late < 64).all()
    env = Player.read(tmp_path / "agent.safetensors").make()
    np.testing.assert_array_equal(
        env.reset(seed=1)[0], show(task, "stacked_x_hat", str(tmp_path / "observer.safetensors")).reset(seed=1)[0]
    )


def test_a_file_that_is_given_is_the_agents_whatever_else_lies_there(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "settings_of", SMALL.get)
    estimator(PENDULUM).save(tmp_path / "observer.safetensors")
    given = tmp_path / "given.safetensors"
    estimator(PENDULUM).save(given)
    learn_to_play(PENDULUM, "stacked_x_hat", tmp_path, algorithm="sac", observer=str(given))
    assert Player.read(tmp_path / "agent.safetensors").observer == str(given)
