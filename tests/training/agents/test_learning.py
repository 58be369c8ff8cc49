"""Agents in any environment learn, and observers for them."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from observers import Artifact
from training.agents.any_environment import observing
from training.agents.any_environment.information import show
from training.agents.any_environment.learning import ALGORITHMS, hyperparameters, learn_to_play, settings_of
from training.agents.any_environment.observing import KKL, Told, learn_observer
from training.agents.any_environment.player import Player
from training.agents.any_environment.task import HIDDEN_VELOCITIES, HiddenTask
from training.progress import ProgressBars

PENDULUM = HIDDEN_VELOCITIES["Pendulum-v1"]
CART = HIDDEN_VELOCITIES["CartPole-v1"]
NOISY_CART = replace(CART, measurement_noise=0.1)
QUIET = ProgressBars(None)


def steps_of(records):
    return sum(len(record.t) - 1 for record in records)


def play_at_random(env, steps, seed=0):
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for _ in range(steps):
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset()


def test_all_settings_are_ones_of_their_algorithm():
    of_the_run = {"policy", "n_envs", "n_timesteps", "normalize", "noise_type", "noise_std"}
    for name, algorithm in ALGORITHMS.items():
        for env_id in settings_of(name):
            found = hyperparameters(name, env_id)
            assert found["n_timesteps"] > 0
            assert set(found) <= set(algorithm.__init__.__annotations__) | of_the_run, (name, env_id)
    for env_id in settings_of("ppo_lstm").keys() - {"default"}:  # as many steps as those compared with it
        other = "sac" if env_id in settings_of("sac") else "ppo"
        assert hyperparameters("ppo_lstm", env_id)["n_timesteps"] == hyperparameters(other, env_id)["n_timesteps"]
    hyperparameters("sac", "Pendulum-v1")["policy_kwargs"]["net_arch"] = None  # of a copy
    assert hyperparameters("sac", "Pendulum-v1")["policy_kwargs"]["net_arch"] == [64, 64]


@pytest.mark.parametrize(
    ("algorithm", "task", "kind"),
    [("ppo", CART, "z"), ("dqn", CART, "state"), ("sac", PENDULUM, "stacked"), ("td3", PENDULUM, "y")],
)
def test_a_file_acts_as_the_agent_that_was_trained(tmp_path, small, algorithm, task, kind):
    model = learn_to_play(task, kind, tmp_path, algorithm=algorithm)
    player, scaling = Player.read(tmp_path / "agent.safetensors"), model.get_vec_normalize_env()
    env = player.make()
    obs, _ = env.reset(seed=3)
    env.action_space.seed(3)
    for _ in range(30):
        scaled = obs if scaling is None else scaling.normalize_obs(obs)
        expected, _ = model.predict(scaled, deterministic=True)
        np.testing.assert_allclose(player.act(obs, env.action_space), expected, atol=1e-5)
        obs, _, terminated, _, _ = env.step(env.action_space.sample())
        if terminated:
            obs, _ = env.reset()
    rows = np.stack([obs, obs])
    np.testing.assert_allclose(player.act(rows, env.action_space)[1], player.act(obs, env.action_space), atol=1e-5)
    assert player.training["algorithm"] == algorithm
    assert list(pd.read_csv(tmp_path / "curve.csv")) == ["steps", "seconds", "return"]


def test_equal_seeds_give_equal_agents(tmp_path, small):
    learn_to_play(CART, "y", tmp_path / "a", seed=1)
    learn_to_play(CART, "y", tmp_path / "b", seed=1)
    learn_to_play(CART, "y", tmp_path / "c", seed=2)
    one, same, other = (Player.read(tmp_path / name / "agent.safetensors").network for name in "abc")
    assert all((a == b).all() for a, b in zip(one.weights, same.weights, strict=True))
    assert any((a != b).any() for a, b in zip(one.weights, other.weights, strict=True))


def test_an_agent_on_estimates_is_told_the_truth_until_there_are_some(tmp_path, small):
    model = learn_to_play(CART, "x_hat", tmp_path, timesteps=300, observer_steps=200)
    path = tmp_path / "agent.safetensors"
    player = Player.read(path)
    assert player.observer == str(tmp_path / "observer.safetensors")
    assert player.make().reset(seed=0)[0].shape == (4,)  # two positions, two estimates
    assert 300 <= model.num_timesteps < 400
    curve = pd.read_csv(tmp_path / "curve.csv")
    assert curve.steps.min() < 200 < curve.steps.max()
    moved = tmp_path / "moved.safetensors"
    content = bytearray((tmp_path / "observer.safetensors").read_bytes())
    moved.write_bytes(content)
    assert player.make(observer=str(moved))
    content[-1] ^= 1
    moved.write_bytes(content)
    with pytest.raises(ValueError, match=r"another observer|checksum|damaged"):
        player.make(observer=str(moved))


@pytest.mark.parametrize(
    ("task", "algorithm", "timesteps", "aggregate", "told"),
    [
        (CART, "ppo", 320, 1, 288 + 2),  # it stops with the first step of what it would collect next
        (CART, "ppo", 98, 0, 64 + 2),  # the third time is with estimates
        (PENDULUM, "sac", 97, 1, 87 + 1),
        (NOISY_CART, "ppo", 320, 1, 32),
    ],
)
def test_who_is_told_the_truth_how_long(tmp_path, small, task, algorithm, timesteps, aggregate, told):
    fitted = []

    def noted(task, records, **options):
        fitted.extend(records)
        raise StopIteration

    options = {"algorithm": algorithm, "timesteps": timesteps, "aggregate": aggregate}
    with pytest.raises(StopIteration):
        learn_to_play(task, "x_hat", tmp_path, **options, estimation=replace(KKL, learn=noted))
    assert steps_of(fitted) == told


def test_refits_are_to_what_the_agent_did_before_too(tmp_path, small):
    fitted, before = [], []

    def noted(task, records, **options):
        fitted.extend(records)
        return KKL.learn(task, records, **options)

    def refits(*given):
        before.extend(given[-1])
        return KKL.refits(*given)

    estimation = replace(KKL, learn=noted, refits=refits)
    learn_to_play(CART, "x_hat", tmp_path, timesteps=600, aggregate=1, estimation=estimation)
    first, again = ([record.fingerprint for record in records] for records in (fitted, before))
    assert sorted(first) == sorted(again)
    assert first != again  # of two rows side by side what ended first is first
    assert {first[-1], again[-1]} <= {again[-1], again[-2]}


def test_an_observer_is_learned_from_the_latest_steps(monkeypatch):
    def played():
        told = Told(CART, 2)
        for env in (told.make(), told.make()):
            play_at_random(env, 200)
        return [record.fingerprint for record in told.records()], steps_of(told.records())

    everything, steps = played()
    monkeypatch.setattr(observing, "KEPT", 100)
    latest, fewer = played()
    assert steps == 400
    assert 100 <= fewer < 200
    half, kept = len(everything) // 2, len(latest) // 2  # of each environment
    assert latest == [*everything[half - kept : half], *everything[-kept:]]


@pytest.mark.parametrize("task", [CART, PENDULUM], ids=["no bounds", "bounds"])
def test_what_is_told_stands_where_estimates_will(tmp_path, small, task):
    told = Told(task, 1)
    env = told.make()
    play_at_random(env, 250)
    records = told.records()  # the last episode is cut
    assert steps_of(records) == 250
    later = show(task, "x_hat", str(learn_observer(task, records, tmp_path, seed=0, progress=QUIET)))
    assert env.observation_space == later.observation_space
    truth, _ = env.reset(seed=3)
    _, info = later.reset(seed=3)
    np.testing.assert_allclose(truth, np.concatenate([info["y"], info["x"]]), rtol=1e-6)


@pytest.mark.parametrize("task", [CART, NOISY_CART])
def test_short_episodes_are_no_error(tmp_path, small, task):
    """Neither at the end nor where the longest one is held out, as of this seed."""
    options = {"algorithm": "dqn", "timesteps": 600, "observer_steps": 300, "aggregate": 1, "seed": 11}
    learn_to_play(task, "x_hat", tmp_path, **options)
    player = Player.read(tmp_path / "agent.safetensors")
    assert player.observer == str(tmp_path / "observer.safetensors")
    assert player.make().reset(seed=0)[0].shape == (4,)


def test_an_observer_is_fitted_again_to_what_the_agent_does(tmp_path, small):
    task, first = replace(PENDULUM, measurement_noise=0.1), []

    def noted(*arguments, **options):
        path = KKL.learn(*arguments, **options)
        first.append(Artifact.read(path))
        return path

    options = {"algorithm": "ppo", "timesteps": 1200, "observer_steps": 400, "aggregate": 1}
    learn_to_play(task, "x_hat", tmp_path, **options, estimation=replace(KKL, learn=noted))
    path = tmp_path / "observer.safetensors"
    artifact = Artifact.read(path)
    assert artifact.training["held_out_errors"] != first[0].training["held_out_errors"]  # a refit was taken
    assert artifact.signals["hidden"] == ["info[clean][0]", "info[clean][1]", "info[clean][2]"]
    assert artifact.signals["measured"] == ["obs[0]", "obs[1]"]
    obs, info = show(task, "x_hat", str(path)).reset(seed=0)
    assert obs.shape == (3,)
    np.testing.assert_array_equal(info["x"], info["clean"])
    assert not np.allclose(info["y"], info["clean_y"])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"information": "y", "observer": "a.safetensors"}, "no use for the observer"),
        ({"information": "z", "aggregate": 2}, "no observer to fit again"),
        ({"information": "z", "algorithm": "ppo_lstm"}, "only that"),
        ({"information": "x_hat", "observer_steps": 10**9}, "fewer than all"),
        ({"information": "x_hat", "timesteps": 4}, r"4 steps are too few .*--timesteps"),
        ({"information": "z", "observer_steps": 10}, "for agents on x_hat that are given no observer"),
        ({"information": "z", "timesteps": 0}, "must be positive"),
        ({"information": "z", "algorithm": "reinforce"}, "unknown algorithm"),
        ({"information": "y", "algorithm": "dqn"}, "take ppo, a2c, sac"),
        ({"task": CART, "information": "y", "algorithm": "sac"}, "take ppo, a2c or dqn"),
        ({"task": HiddenTask("FrozenLake-v1", (0,)), "information": "y", "algorithm": "td3"}, "take ppo"),
        ({"task": replace(CART, measured=(0, 1, 2, 3)), "information": "x_hat"}, "nothing is left to estimate"),
        (
            {"task": CART, "information": "x_hat", "timesteps": 34, "observer_steps": 6},
            r"ppo collects 34 steps before it goes on; give it more than 34 .--timesteps",
        ),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, small, options, says):
    task, information = options.pop("task", PENDULUM), options.pop("information")
    with pytest.raises(ValueError, match=says):
        learn_to_play(task, information, tmp_path, **options)
