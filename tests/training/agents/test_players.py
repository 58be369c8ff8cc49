"""Agents in any environment: what they are shown, that files act as what was trained, and their comparison."""

import json
import shutil
import warnings
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium.utils.env_checker import check_env
from rich.console import Console

from examples.research.agents.command import Compare
from examples.research.environments.command import COLUMNS, unusual
from examples.research.environments.comparison import Case, collect, planned, run_case
from examples.research.environments.tables import cell, curves, write_table
from observers import MLP, Artifact
from observers.storage import checksum
from training.agents.agent import AgentError
from training.agents.any_environment import learning, observing
from training.agents.any_environment.information import ESTIMATES, SHOWN, Stacked, show
from training.agents.any_environment.learning import hyperparameters, learn_to_play, settings_of
from training.agents.any_environment.observing import Told, learn_observer, wander
from training.agents.any_environment.player import Player
from training.agents.any_environment.task import HIDDEN_VELOCITIES, HiddenTask
from training.commands.agent import Evaluate, Train
from training.commands.environment import EnvironmentOptions
from training.commands.record import RecordCommand
from training.commands.running import Workers
from training.progress import ProgressBars
from training.records import read_records

PENDULUM = HIDDEN_VELOCITIES["Pendulum-v1"]
CART = HIDDEN_VELOCITIES["CartPole-v1"]
SMALL = {
    "ppo": {"n_envs": 2, "n_timesteps": 64, "policy": "MlpPolicy", "n_steps": 16, "batch_size": 16, "normalize": True},
    "a2c": {"n_envs": 2, "n_timesteps": 64, "policy": "MlpPolicy", "normalize": True},
    "dqn": {"n_timesteps": 64, "policy": "MlpPolicy", "learning_starts": 16},
    "sac": {"n_timesteps": 48, "policy": "MlpPolicy", "learning_starts": 32},
    "td3": {"n_timesteps": 48, "policy": "MlpPolicy", "learning_starts": 32, "noise_type": "normal", "noise_std": 0.1},
    "tqc": {"n_timesteps": 48, "policy": "MlpPolicy", "learning_starts": 32},
    "ppo_lstm": {"n_envs": 2, "n_timesteps": 64, "policy": "MlpLstmPolicy", "n_steps": 16, "batch_size": 16},
}


@pytest.fixture
def small(monkeypatch):
    """Settings with which everything is learned in no time, and badly."""
    for name in SMALL:
        settings_of(name)
    monkeypatch.setattr(
        learning,
        "settings_of",
        lambda name: {
            "default": {**SMALL[name], "policy_kwargs": {"net_arch": [8]}},
            **({"Pendulum-v1": {**SMALL["sac"], "policy_kwargs": {"net_arch": [8]}}} if name == "sac" else {}),
        },
    )
    monkeypatch.setattr("training.agents.any_environment.observing.SETTINGS", {"inverse_steps": 20, "members": 1})


def test_all_settings_are_ones_of_their_algorithm():
    for name, algorithm in learning.ALGORITHMS.items():
        for env_id in settings_of(name):
            found = hyperparameters(name, env_id)
            assert found["n_timesteps"] > 0
            known = set(algorithm.__init__.__annotations__) | set(learning._OF_THE_RUN) | {"policy"}
            assert set(found) <= known, (name, env_id)


def test_settings_are_given_out_as_copies():
    hyperparameters("sac", "Pendulum-v1")["policy_kwargs"]["net_arch"] = None
    assert hyperparameters("sac", "Pendulum-v1")["policy_kwargs"]["net_arch"] == [64, 64]


def test_noise_lies_on_what_is_measured_and_leaves_episodes_as_they_are():
    clean, noisy = PENDULUM.make(), replace(PENDULUM, measurement_noise=0.3).make()
    apart = []
    for seed in range(3):
        for env in (clean, noisy):
            env.reset(seed=seed)
        for _ in range(200):
            here, there = (env.step(np.array([0.5], dtype=np.float32))[0] for env in (clean, noisy))
            apart.append(there - here)
    spread = np.std(apart, axis=0)
    np.testing.assert_allclose(spread[:2], 0.3, rtol=0.1)
    assert spread[2] == 0
    assert abs(np.corrcoef(np.array(apart)[:, :2].T)[0, 1]) < 0.15
    again = [replace(PENDULUM, measurement_noise=0.3).make().reset(seed=4)[0] for _ in range(2)]
    np.testing.assert_array_equal(*again)


@pytest.mark.parametrize("kind", sorted({*SHOWN} - {*ESTIMATES}))
@pytest.mark.parametrize(
    "task",
    [PENDULUM, replace(CART, measurement_noise=0.1), replace(PENDULUM, angles=((0, 1),))],
    ids=["pendulum", "cart", "angle"],
)
def test_what_is_shown_passes_gymnasiums_checker(task, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about bounds that are infinite, and that the environment is wrapped
        check_env(show(task, kind), skip_render_check=True)


def test_stacked_observations_hold_actions_and_begin_with_the_first():
    env, plain = show(PENDULUM, "stacked"), show(PENDULUM, "y")
    first, _ = env.reset(seed=0)
    y0, _ = plain.reset(seed=0)
    np.testing.assert_array_equal(first.reshape(8, 3), np.tile([*y0, 0], (8, 1)))
    seen = [np.append(y0, 0)]
    for k in range(10):
        action = np.array([np.sin(k)], dtype=np.float32)
        shown = env.step(action)[0]
        seen.append(np.append(plain.step(action)[0], action / 2))  # of torques within ±2
        expected = [*[seen[0]] * (8 - len(seen)), *seen[-8:]]
        np.testing.assert_allclose(shown.reshape(8, 3), expected, rtol=1e-6)
    np.testing.assert_array_equal(show(PENDULUM, "recurrent").reset(seed=0)[0], [*y0, 0])


def test_a_task_says_how_long_memories_and_stacks_are(tmp_path):
    task = replace(PENDULUM, time_constants=(1, 2), frames=4)
    assert show(task, "stacked").observation_space.shape == (4 * 3,)
    z = show(task, "z")
    assert z.observation_space.shape == (2 + 2 * 2 + 2,)
    assert z.get_wrapper_attr("spec").additional_wrappers[-1].kwargs["time_constants"] == (1.0, 2.0)
    path = tmp_path / "agent.safetensors"
    network = MLP([np.zeros((1, 8))], [np.zeros(1)], "tanh")
    player(task=task, information="z", network=network).save(path)
    assert Player.read(path).task == task
    assert Player.read(path).make().observation_space == z.observation_space


def test_past_actions_can_be_left_out():
    z, stacked = (show(replace(CART, past_actions=False), kind) for kind in ("z", "stacked"))
    assert z.observation_space.shape == (2 + 2 * 4,)
    seen = [z.reset(seed=0)[0], *(z.step(action)[0] for action in (0, 1, 1))]
    first = stacked.reset(seed=0)[0]
    for action in (0, 1, 1):
        last = stacked.step(action)[0]
    np.testing.assert_array_equal(first, np.tile(seen[0][:2], 8))
    np.testing.assert_array_equal(last.reshape(8, 2)[-4:], np.array(seen)[:, :2])
    np.testing.assert_array_equal(last.reshape(8, 2)[:4], np.tile(seen[0][:2], (4, 1)))
    check = (stacked.observation_space.shape, stacked.observation_space.contains(last))
    assert check == ((16,), True)


def test_agents_on_memories_and_stacks_can_be_told_of_angles(tmp_path):
    task = replace(PENDULUM, measured=(1, 0), angles=((0, 1),), frames=4)
    z = show(task, "z")
    assert z.observation_space.shape == (2 + 4 + 2,)
    env, plain = show(task, "stacked"), show(task, "y")
    (first, _), (y0, _) = env.reset(seed=0), plain.reset(seed=0)
    np.testing.assert_array_equal(first, np.float32([0, 0] * 3 + [*y0, 0]))
    turned, actions, rate = [0.0] * 4, [0.0] * 4, 0.0
    for _ in range(60):
        action = np.array([2.0 if rate >= 0 else -2.0], dtype=np.float32)  # which swings it all around
        shown = env.step(action)[0]
        y = plain.step(action)[0]
        rate = env.unwrapped.state[1]
        turned = [*turned[1:], turned[-1] + 0.05 * rate]  # Euler's, with the new rate
        actions = [*actions[1:], action[0] / 2]
        earlier = np.stack([actions[:3], turned[-1] - np.array(turned[:3])], axis=1).ravel()
        np.testing.assert_allclose(shown, [*earlier, *y, actions[-1]], atol=1e-5)
        assert shown in env.observation_space
    assert abs(turned[-1]) > 2 * np.pi
    path = tmp_path / "agent.safetensors"
    player(task=task, information="z", network=MLP([np.zeros((1, 8))], [np.zeros(1)], "tanh")).save(path)
    assert Player.read(path).task == task
    assert Player.read(path).make().observation_space == z.observation_space


def test_stacks_of_angles_outlive_samples_without_one():
    class Blind(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (2,))
        action_space = gym.spaces.Box(-1, 1, (1,))
        seen = np.float32([1, 0])

        def reset(self, *, seed=None, options=None):
            return self.seen, {}

        def step(self, action):
            return self.seen, 0.0, False, False, {}

    for nothing in ([0, 0], [np.nan, 0], [-0.0, -0.0]):
        env = Stacked(Blind(), 3, [(0, 1)], actions=False)
        env.reset()
        env.unwrapped.seen = np.float32(nothing)
        env.step(np.zeros(1))
        env.unwrapped.seen = np.float32([0, 1])
        np.testing.assert_allclose(env.step(np.zeros(1))[0], [np.pi / 2, np.pi / 2, 0, 1], atol=1e-6)
        env.unwrapped.seen[:] = [-1, 0]  # a buffer that is filled again
        np.testing.assert_allclose(env.step(np.zeros(1))[0], [np.pi, np.pi / 2, -1, 0], atol=1e-6)


def test_the_full_state_is_without_noise():
    noisy = replace(PENDULUM, measurement_noise=0.3)
    np.testing.assert_array_equal(show(noisy, "state").reset(seed=1)[0], PENDULUM.make().reset(seed=1)[0])


@pytest.mark.parametrize(
    ("algorithm", "task", "kind"),
    [
        ("ppo", CART, "z"),
        ("ppo", PENDULUM, "y"),
        ("a2c", CART, "stacked"),
        ("dqn", CART, "state"),
        ("sac", PENDULUM, "z"),
        ("td3", PENDULUM, "y"),
        ("tqc", PENDULUM, "state"),
    ],
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
        action = player.act(obs, env.action_space)
        np.testing.assert_allclose(action, expected, atol=1e-5)
        obs, _, terminated, _, _ = env.step(env.action_space.sample())
        if terminated:
            obs, _ = env.reset()
    rows = np.stack([obs, obs])
    np.testing.assert_allclose(player.act(rows, env.action_space)[1], player.act(obs, env.action_space), atol=1e-5)
    assert player.training["algorithm"] == algorithm
    curve = pd.read_csv(tmp_path / "curve.csv")
    assert list(curve) == ["steps", "seconds", "return"]


def test_an_agent_on_estimates_is_told_the_truth_until_there_are_some(tmp_path, small, monkeypatch):
    seen, learned = [], learning.learn_observer

    def noted(task, records, folder, **options):
        seen.extend(records)
        return learned(task, records, folder, **options)

    monkeypatch.setattr(learning, "learn_observer", noted)
    model = learn_to_play(CART, "x_hat", tmp_path, timesteps=1000, observer_steps=900)
    player = Player.read(tmp_path / "agent.safetensors")
    assert player.observer == str(tmp_path / "observer.safetensors")
    obs, _ = player.make().reset(seed=0)
    assert obs.shape == (4,)  # two positions, two estimates
    assert 900 <= sum(len(record.t) - 1 for record in seen) < 1000 <= model.num_timesteps < 1100
    curve = pd.read_csv(tmp_path / "curve.csv")
    assert curve.steps.min() < 900 < curve.steps.max()
    shutil.copy(tmp_path / "observer.safetensors", tmp_path / "moved.safetensors")
    assert player.make(observer=str(tmp_path / "moved.safetensors"))
    content = bytearray((tmp_path / "moved.safetensors").read_bytes())
    content[-1] ^= 1
    (tmp_path / "moved.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match=r"another observer|checksum|damaged"):
        player.make(observer=str(tmp_path / "moved.safetensors"))


@pytest.mark.parametrize(
    ("task", "algorithm", "timesteps", "aggregate", "told"),
    [
        (CART, "ppo", 1600, 0, 1440 + 2),  # it stops with the first step of what it would collect next
        (CART, "ppo", 1600, 1, 1440 + 2),
        (CART, "ppo", 1610, 1, 1472 + 2),
        (CART, "ppo", 99, 0, 96 + 2),  # the fourth time is with estimates
        (CART, "ppo", 98, 0, 64 + 2),  # and here the third
        (CART, "a2c", 97, 1, 80 + 2),
        (PENDULUM, "sac", 97, 1, 87 + 1),
        (PENDULUM, "sac", 800, 1, 720 + 1),
        (replace(CART, measurement_noise=0.1), "ppo", 1600, 1, 160),
    ],
)
def test_who_is_told_the_truth_how_long(tmp_path, small, monkeypatch, task, algorithm, timesteps, aggregate, told):
    fitted = []

    def noted(task, records, folder, **options):
        fitted.extend(records)
        raise StopIteration

    monkeypatch.setattr(learning, "learn_observer", noted)
    with pytest.raises(StopIteration):
        learn_to_play(task, "x_hat", tmp_path, algorithm=algorithm, timesteps=timesteps, aggregate=aggregate)
    assert sum(len(record.t) - 1 for record in fitted) == told


def test_refits_are_to_what_the_agent_did_before_too(tmp_path, small, monkeypatch):
    fitted, refitted = [], []
    learned, refitting = learning.learn_observer, learning.refitting

    def noted(task, records, folder, **options):
        fitted.append(records)
        return learned(task, records, folder, **options)

    monkeypatch.setattr(learning, "learn_observer", noted)
    monkeypatch.setattr(learning, "refitting", lambda *given: refitted.append(refitting(*given)) or refitted[0])
    learn_to_play(CART, "x_hat", tmp_path, timesteps=1000, aggregate=1)
    first, again = ([record.fingerprint for record in records] for records in (fitted[0], refitted[0]._before))
    assert sorted(first) == sorted(again)
    assert first != again  # of two rows side by side what ended first is first
    assert {first[-1], again[-1]} <= {again[-1], again[-2]}


def test_an_observer_is_learned_from_the_latest_steps(monkeypatch):
    def played():
        told = Told(CART, 2)
        for row, env in enumerate([told.make(), told.make()]):
            env.action_space.seed(row)
            env.reset(seed=row)
            for _ in range(200):
                if any(env.step(env.action_space.sample())[2:4]):
                    env.reset()
        return told.records()

    everything = played()
    assert sum(len(record.t) - 1 for record in everything) == 400
    monkeypatch.setattr(observing, "KEPT", 100)
    latest = played()
    ends = np.cumsum([len(record.t) - 1 for record in everything])
    half = int(np.searchsorted(ends, 200)) + 1
    assert ends[half - 1] == 200
    for row in (everything[:half], everything[half:]):
        kept = [record.fingerprint for record in row if record.fingerprint in {other.fingerprint for other in latest}]
        assert kept == [record.fingerprint for record in row[-len(kept) :]]
        steps = [len(record.t) - 1 for record in row[-len(kept) :]]
        assert sum(steps[1:]) < 50 <= sum(steps)


@pytest.mark.parametrize("task", [CART, PENDULUM], ids=["no bounds", "bounds"])
def test_what_is_told_stands_where_estimates_will(tmp_path, small, task):
    told = Told(task, 1)
    env = told.make()
    path = learn_observer(task, _played(told, env), tmp_path, seed=0, progress=ProgressBars(None))
    later = show(task, "x_hat", str(path))
    assert env.observation_space == later.observation_space
    truth, _ = env.reset(seed=3)
    _, info = later.reset(seed=3)
    np.testing.assert_allclose(truth, np.concatenate([info["y"], info["x"]]), rtol=1e-6)


@pytest.mark.parametrize("seed", [5, 8, 10])
def test_the_filter_settles_in_an_episode_that_is_trained_on(tmp_path, small, seed):
    """Of these few random steps the longest episode is held out."""
    task = replace(CART, measurement_noise=0.1)
    records = wander(task, 600, seed=seed, progress=ProgressBars(None))
    assert learn_observer(task, records, tmp_path, seed=seed, progress=ProgressBars(None)).exists()


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_short_episodes_at_the_end_are_no_error(tmp_path, small, noise):
    task = replace(CART, measurement_noise=noise)
    learn_to_play(task, "x_hat", tmp_path, algorithm="dqn", timesteps=1000, observer_steps=300, aggregate=1)
    player = Player.read(tmp_path / "agent.safetensors")
    assert player.observer == str(tmp_path / "observer.safetensors")
    assert player.make().reset(seed=0)[0].shape == (4,)


def test_an_agent_that_would_never_see_an_estimate_is_refused(tmp_path, small):
    with pytest.raises(ValueError, match=r"ppo collects 34 steps before it goes on; give it more than 34 .--timesteps"):
        learn_to_play(CART, "x_hat", tmp_path, timesteps=34, observer_steps=6)


def _played(told, env):
    """Records of some steps at random, of which the last episode is cut."""
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(250):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    records = told.records()
    assert sum(len(record.t) - 1 for record in records) == 250
    return records


def player(**changes):
    given = {
        "network": MLP([np.zeros((1, 2))], [np.zeros(1)], "tanh"),
        "head": "clip",
        "task": PENDULUM,
        "information": "y",
    }
    return Player(**{**given, **changes})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"head": "softmax"}, "head"),
        ({"information": "everything"}, "information"),
        ({"observer": 3}, "observer must be a string"),
        ({"mean": np.zeros(2)}, "belong together"),
        ({"mean": np.zeros(2), "scale": np.array([1.0, np.nan])}, "2 finite numbers"),
        ({"mean": np.zeros(3), "scale": np.ones(3)}, "2 finite numbers"),
        ({"training": None}, "training must be a mapping"),
    ],
)
def test_a_player_that_makes_no_sense_is_refused(changes, says):
    with pytest.raises(AgentError, match=says):
        player(**changes)


def test_a_player_of_another_size_or_kind_is_refused():
    with pytest.raises(AgentError, match="2 inputs and 1 outputs, the environment 3 and 1"):
        player(information="state").make()
    with pytest.raises(AgentError, match="head is argmax"):
        player(head="argmax").make()


def test_a_strangers_environment_is_not_made_unless_it_is_named(tmp_path):
    path = tmp_path / "agent.safetensors"
    player(task=HiddenTask("no_such_module:Evil-v0", (0, 1))).save(path)
    found = Player.read(path)
    with pytest.raises(AgentError, match="if you trust"):
        found.make()
    with pytest.raises(AgentError, match="if you trust"):
        found.make(env_id="Pendulum-v1")
    with pytest.raises(ValueError, match="no_such_module"):
        found.make(env_id="no_such_module:Evil-v0")


def test_damaged_and_foreign_files_are_refused(tmp_path):
    path = tmp_path / "agent.safetensors"
    player().save(path)
    assert Player.read(path).task == PENDULUM
    content = path.read_bytes()
    path.write_bytes(content[:-3])
    with pytest.raises(AgentError, match="damaged"):
        Player.read(path)
    with pytest.raises(AgentError, match="no file"):
        Player.read(tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"measured": ()}, "measured must name"),
        ({"measured": (0, 0)}, "each once"),
        ({"measured": (0.5,)}, "entry of measured"),
        ({"measured": (0,), "measurement_noise": -1.0}, "from 0 on"),
        ({"measured": (0,), "measurement_noise": np.nan}, "from 0 on"),
        ({"measured": (0,), "time_constants": (2.0, 1.0)}, "must rise"),
        ({"measured": (0,), "time_constants": ()}, "at least one"),
        ({"measured": (0,), "past_actions": "no"}, "past_actions must be"),
        (
            {"measured": (0,), "angles": ((0, 1),)},
            r"of Pendulum-v1 that are measured, \(0,\), each once, got \(\(0, 1\),\)",
        ),
        ({"measured": (0, 1), "angles": ((0, 0),)}, "each once"),
        ({"measured": (0, 1), "angles": ((0, -1),)}, "a sine must be an integer, not negative, got -1"),
        ({"measured": (0, 1), "angles": (0, 1)}, "angles must be pairs of entries"),
        ({"measured": (0, 1), "angles": ((0,),)}, "angles must be pairs of entries"),
        ({"measured": (0, 1), "angles": ([0, [1]],)}, "a sine must be an integer"),
        ({"measured": (0, 1), "angles": None}, "angles must be pairs of entries"),
        ({"measured": (0,), "frames": 0}, "frames must be"),
        ({"measured": (0,), "frames": 2.5}, "frames must be"),
        ({"measured": (0,), "frames": 10**9}, "frames must be"),
    ],
)
def test_a_task_that_makes_no_sense_is_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        HiddenTask("Pendulum-v1", **arguments)


def test_entries_and_environments_that_are_not_there_are_named():
    with pytest.raises(ValueError, match=r"no entry 7 .* 0 to 2"):
        HiddenTask("Pendulum-v1", (7,)).make()
    with pytest.raises(ValueError, match="cannot make 'Pendulam-v1'"):
        HiddenTask("Pendulam-v1", (0,)).make()
    with pytest.raises(ValueError, match="one of state"):
        show(PENDULUM, "nothing")
    with pytest.raises(ValueError, match="needs an observer"):
        show(PENDULUM, "x_hat")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"information": "y", "observer": "a.safetensors"}, "no use for the observer"),
        ({"information": "z", "aggregate": 2}, "no observer to fit again"),
        ({"information": "z", "algorithm": "ppo_lstm"}, "only that"),
        ({"information": "recurrent", "algorithm": "ppo"}, "only that"),
        ({"information": "x_hat", "observer_steps": 10**9}, "fewer than all"),
        ({"information": "x_hat", "timesteps": 4}, r"4 steps are too few .*--timesteps"),
        ({"information": "z", "observer_steps": 10}, "for agents on x_hat or stacked_x_hat that are given"),
        ({"information": "z", "timesteps": 0}, "must be positive"),
        ({"information": "z", "algorithm": "reinforce"}, "unknown algorithm"),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, options, says):
    information = options.pop("information")
    with pytest.raises(ValueError, match=says):
        learn_to_play(PENDULUM, information, tmp_path, **options)


@pytest.mark.parametrize(
    ("task", "algorithm", "says"),
    [
        (CART, "sac", "take ppo, a2c or dqn"),
        (PENDULUM, "dqn", "take ppo, a2c, sac"),
        (HiddenTask("FrozenLake-v1", (0,)), "td3", "take ppo"),
    ],
)
def test_algorithms_that_cannot_act_there_are_refused(tmp_path, task, algorithm, says):
    with pytest.raises(ValueError, match=says):
        learn_to_play(task, "y", tmp_path, algorithm=algorithm)


def test_a_comparison_resumes_and_says_what_is_missing(tmp_path, small):
    options = {"environments": ("CartPole-v1",), "seeds": 3, "episodes": 4, "workers": Workers(1), "out": tmp_path}
    Compare(**options, information=("state", "y")).run(Console())
    results = pd.read_csv(tmp_path / "results.csv")
    assert sorted(results.shown) == ["random", *["state"] * 3, *["y"] * 3]
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("jobs/**/result.json")}
    shutil.rmtree(tmp_path / "jobs" / "CartPole-v1" / "y" / "1")
    Compare(**options, information=("y",)).run(Console())  # a narrower run reports all that is there
    again = pd.read_csv(tmp_path / "results.csv")
    assert again.drop(columns="seconds").equals(results.drop(columns="seconds"))  # all is seeded
    changed = [path for path in before if path.stat().st_mtime_ns != before[path]]
    assert [path.parent.name for path in changed] == ["1"]
    table = (tmp_path / "table.md").read_text()
    assert "| CartPole-v1 |" in table
    assert "Partial" not in table
    for name in ("scores.png", "curves.png", "curves.csv"):
        assert (tmp_path / name).stat().st_size > 100
    assert "frames" not in table
    with pytest.raises(ValueError, match="another comparison: episodes = 4 there, 5 here"):
        Compare(**{**options, "episodes": 5}, information=("y",)).run(Console())


def test_lengths_of_memories_and_stacks_tell_apart_those_agents_alone(tmp_path):
    def differ(changed):
        cases = {kind: [Case(task, kind, 0, 2, None, 0, tmp_path) for task in (PENDULUM, changed)] for kind in KINDS}
        return {kind for kind, (one, other) in cases.items() if one.identity != other.identity}

    KINDS = ("random", *SHOWN)
    assert differ(replace(PENDULUM, time_constants=(1, 2, 4), frames=9)) == {"z", "stacked", "stacked_x_hat"}
    assert differ(replace(PENDULUM, angles=((0, 1),))) == {"z", "stacked"}
    assert differ(replace(PENDULUM, past_actions=False)) == {"z", "stacked"}
    for kind in SHOWN:  # as comparisons were written before there were these options
        assert not {"angles", "past_actions"} & set(Case(PENDULUM, kind, 0, 2, None, 0, tmp_path).identity["task"])


def test_a_table_says_what_agents_were_told():
    told = EnvironmentOptions(angles=("0,1",), frames=2, no_past_actions=True)
    says = "Agents on z and on stacked observations: `frames` 2, `past_actions` False, `angles` ((0, 1),)."
    assert unusual([told.task("Pendulum-v1", noise) for noise in (0.0, 0.1)]) == says
    assert unusual([PENDULUM, CART]) == ""


def test_an_agent_that_was_interrupted_is_trained_anew(tmp_path, small, monkeypatch):
    case = Case(CART, "x_hat", 0, 2, 400, 1, tmp_path / "job")
    with monkeypatch.context() as patched:
        patched.setattr(learning, "refitting", lambda *_: 1 / 0)  # once its observer is learned
        with pytest.raises(ZeroDivisionError):
            run_case(case)
    assert not case.done
    run_case(case)
    assert case.done


EARLIER = {
    "Ball-v0,0.0,state,0,much,3.0": "column return holds something that is no number",
    "Ball-v0,0.0,state,0,,3.0": "row 3 lacks a value",
    ",0.0,state,0,1.0,3.0": "row 3 lacks a value",
    "Ball-v0,0.0,everything,0,1.0,3.0": "shown everything; known are state, x_hat",
    "Ball-v0,0.0,random,0,1.0,0.0": "row 3 says again what one before it says",
    "Ball-v0,0.0,state,0,1.0,3.0,5,6": "Expected 6 fields in line 3, saw 8",
}


def test_environments_of_an_earlier_comparison_stand_beside_those_of_this(tmp_path, small):
    """What this one's agents are shown is of this one alone."""
    options = {"seeds": 1, "episodes": 2, "workers": Workers(1), "information": ("state", "y")}
    kept = {
        "results.csv": ["Ball-v0,0.0,random,0,1.0,0.0", "Ball-v0,0.0,state,0,11.25,3.0", "Ball-v0,0.0,y,0,6.0,3.5"],
        "curves.csv": ["Ball-v0,0.0,state,10,1.5,2.0", "Ball-v0,0.0,y,10,1.5,0.125"],
    }
    for name, rows in kept.items():
        other = rows[-1].replace("Ball-v0", "CartPole-v1")
        lines = [",".join(COLUMNS[name]), other, other.replace(",y,", ",z,"), *rows]
        (tmp_path / name).write_text("\n".join(lines) + "\n")
    Compare(("CartPole-v1",), **options, out=tmp_path / "out", beside=tmp_path).run(Console())
    for name, rows in kept.items():
        assert (tmp_path / "out" / name).read_text().splitlines()[-len(rows) :] == rows
    results = pd.read_csv(tmp_path / "out" / "results.csv")
    assert list(results.environment) == ["CartPole-v1"] * 4 + ["Ball-v0"] * 3
    assert list(results.shown[:4]) == ["z", "random", "state", "y"]
    assert results["return"][0] == 6.0 != results["return"][3]
    assert "| Ball-v0 | 11.25 (1.00), 1 | – | 6 (0.49), 1 | 1 |" in (tmp_path / "out" / "table.md").read_text()
    for row, says in EARLIER.items():
        (tmp_path / "results.csv").write_text(
            "\n".join([",".join(COLUMNS["results.csv"]), kept["results.csv"][0], row])
        )
        with pytest.raises(ValueError, match=rf"results.csv.*{says}"):
            Compare(("CartPole-v1",), **options, out=tmp_path / "c", beside=tmp_path).run(Console())
    (tmp_path / "results.csv").write_text("environment,steps\n")
    with pytest.raises(ValueError, match=r"results.csv.*its columns are environment, steps, not environment, noise"):
        Compare(("CartPole-v1",), **options, out=tmp_path / "c", beside=tmp_path).run(Console())
    with pytest.raises(OSError, match=r"results.csv"):
        Compare(("CartPole-v1",), **options, out=tmp_path / "c", beside=tmp_path / "none").run(Console())
    assert not (tmp_path / "c").exists()
    (tmp_path / "results.csv").write_text(f"{','.join(COLUMNS['results.csv'])}\nCartPole-v1,0.0,z,10,1.5,0.125\n")
    (tmp_path / "curves.csv").write_text(f"{','.join(COLUMNS['curves.csv'])}\n")  # of agents without an episode
    Compare(("CartPole-v1",), **{**options, "information": ("state",)}, out=tmp_path / "e", beside=tmp_path).run(
        Console()
    )
    assert set(pd.read_csv(tmp_path / "e" / "results.csv").shown) == {"z", "random", "state"}
    with pytest.raises(ValueError, match="--beside is for environments"):
        Compare(out=tmp_path / "d", beside=tmp_path).run(Console())


def test_full_state_agents_are_shared_by_levels_of_noise(tmp_path):
    tasks = [replace(PENDULUM, measurement_noise=level) for level in (0.1, 0.3)]
    cases = planned(tasks, tmp_path, kinds=("state", "y"), seeds=2)
    assert [case.name for case in cases if case.kind == "state"] == ["Pendulum-v1/state/0", "Pendulum-v1/state/1"]
    assert len([case for case in cases if case.kind == "y"]) == 4
    assert len(cases) == 7


def test_there_are_as_many_agents_of_each_kind(tmp_path):
    cases = planned([PENDULUM], tmp_path, kinds=("state", "recurrent"), seeds=4)
    for kind in ("state", "recurrent"):
        assert [case.seed for case in cases if case.kind == kind] == [0, 1, 2, 3]


def test_each_algorithm_learns_from_as_many_steps(tmp_path):
    for env_id in ("CartPole-v1", "Pendulum-v1", "MountainCarContinuous-v0", "LunarLander-v3", "HalfCheetah-v5"):
        algorithms = ("ppo_lstm", "sac" if env_id in settings_of("sac") else "ppo")
        assert len({hyperparameters(name, env_id)["n_timesteps"] for name in algorithms}) == 1


def test_a_table_of_known_results(tmp_path):
    rows = [("random", 0.0, 0, 10.0), *(("state", 0.0, i, 110.0 + i) for i in range(-2, 3))]
    rows += [("y", 0.2, i, 60.0 + 2 * i) for i in range(-2, 3)]
    results = pd.DataFrame(
        [("A-v0", noise, kind, seed, value, 7.0) for kind, noise, seed, value in rows],
        columns=["environment", "noise", "shown", "seed", "return", "seconds"],
    )
    found = cell(results, ("A-v0", 0.2), "y")
    assert found["middle"] == pytest.approx(60)
    assert found["interval"][0] == pytest.approx(0.5)
    assert 0.46 < found["interval"][1] < 0.5 < found["interval"][2] < 0.54
    assert cell(results, ("A-v0", 0.2), "state")["interval"][0] == pytest.approx(1.0)
    assert cell(results, ("A-v0", 0.2), "z") is None
    write_table(tmp_path / "table.md", results, " Partial: one.")
    table = (tmp_path / "table.md").read_text()
    assert "A-v0, noise 0.2 | 110 (1.00, " in table
    assert "| 60 (0.50, " in table
    assert "Partial: one." in table


def test_a_case_that_is_random_has_no_curve(tmp_path, small):
    case = Case(CART, "random", 0, 3, None, 0, tmp_path)
    run_case(case)
    assert len(json.loads((tmp_path / "result.json").read_text())["returns"]) == 3
    assert curves([case]).empty
    assert collect([case])["shown"].tolist() == ["random"]


def test_the_commands_train_and_play(tmp_path, small, capsys):
    options = EnvironmentOptions(measured="0,2")
    Train("CartPole-v1", "z", out=tmp_path, environment=options).run(Console(width=100))
    Evaluate(str(tmp_path / "agent.safetensors"), episodes=3).run(Console(width=100))
    shown = capsys.readouterr().out
    assert "CartPole-v1" in shown
    assert shown.count("return") == 2
    with pytest.raises(FileExistsError, match="holds an agent already"):
        Train("CartPole-v1", "z", out=tmp_path).run(Console())
    with pytest.raises(ValueError, match="leave --resume out"):
        Train("CartPole-v1", "z", out=tmp_path / "b", resume=True).run(Console())
    with pytest.raises(ValueError, match="say what is measured of Acrobot-v1"):
        Train("Acrobot-v1", "z", out=tmp_path / "c").run(Console())
    with pytest.raises(ValueError, match="takes indices"):
        Train("CartPole-v1", "z", out=tmp_path / "d", environment=EnvironmentOptions(measured="x")).run(Console())
    with pytest.raises(ValueError, match="--time-constants takes numbers of steps"):
        EnvironmentOptions(time_constants="1;2").task("CartPole-v1")
    shorter = EnvironmentOptions(time_constants="1,2", frames=4).task("CartPole-v1")
    assert (shorter.time_constants, shorter.frames) == ((1.0, 2.0), 4)
    assert not EnvironmentOptions(no_past_actions=True).task("CartPole-v1").past_actions
    assert EnvironmentOptions(angles=("3,1", "4,2")).task("InvertedDoublePendulum-v5").angles == ((3, 1), (4, 2))
    with pytest.raises(ValueError, match="--angles takes indices"):
        EnvironmentOptions(angles=("cos",)).task("Pendulum-v1")
    with pytest.raises(ValueError, match=r"--angles takes the cosine's entry and the sine's, .* got '0,1,2'"):
        EnvironmentOptions(angles=("0,1,2",)).task("Pendulum-v1")
    with pytest.raises(ValueError, match=r"angles must name entries of CartPole-v1 that are measured, \(0, 2\)"):
        EnvironmentOptions(angles=("0,1",)).task("CartPole-v1")
    for command in (Compare, partial(Train, "lorenz")):  # as in --angles 0,1 without an environment
        with pytest.raises(ValueError, match="--frames, --angles: this is for agents in an environment"):
            command(environment=EnvironmentOptions(angles=("0,1",), frames=2), out=tmp_path / "i").run(Console())
    with pytest.raises(ValueError, match="one number"):
        Train("CartPole-v1", "z", out=tmp_path / "e", measurement_noise=(0.1, 0.2)).run(Console())
    with pytest.raises(ValueError, match="a system knows"):
        Train("lorenz", "recurrent", out=tmp_path / "f").run(Console())
    with pytest.raises(ValueError, match="compared by state"):
        Compare(("CartPole-v1",), information=("ekf",), out=tmp_path / "g").run(Console())
    with pytest.raises(ValueError, match="environments, each once"):
        Compare(("CartPole-v1", "CartPole-v1"), out=tmp_path / "g").run(Console())


def test_an_observer_is_fitted_again_to_what_the_agent_does(tmp_path, small, monkeypatch):
    monkeypatch.setattr("training.agents.any_environment.observing.SETTINGS", {"inverse_steps": 100, "members": 1})
    begun, learned = [], learning.learn_observer

    def noted(*arguments, **options):
        path = learned(*arguments, **options)
        begun.append(checksum(path, ValueError))
        return path

    monkeypatch.setattr(learning, "learn_observer", noted)
    task = replace(PENDULUM, measurement_noise=0.1)
    learn_to_play(task, "x_hat", tmp_path, timesteps=1700, observer_steps=400, aggregate=1, algorithm="ppo")
    player = Player.read(tmp_path / "agent.safetensors")
    artifact = Artifact.read(player.observer)
    assert tuple(artifact.signals["hidden"]) == ("info[clean][0]", "info[clean][1]", "info[clean][2]")
    assert tuple(artifact.signals["measured"]) == ("obs[0]", "obs[1]")
    env = player.make()
    obs, info = env.reset(seed=0)
    assert obs.shape == (3,)
    np.testing.assert_array_equal(info["x"], info["clean"])
    assert not np.allclose(info["y"], info["clean_y"])
    assert checksum(player.observer, ValueError) != begun[0]  # a refit was taken


def test_an_agent_on_the_state_is_recorded_as_a_policy(tmp_path, small, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    learn_to_play(CART, "state", tmp_path)
    path = tmp_path / "agent.safetensors"
    options = {"measured": "0,2", "hidden": "1,3", "policy": str(path), "steps": 30}
    name = RecordCommand("CartPole-v1", **options).run(Console())
    assert name == "cartpole-v1/agent-v0"
    (record, *_) = read_records((f"minari:{name}",))
    player, env = Player.read(path), gym.make("CartPole-v1")
    for k in range(len(record.t) - 1):
        obs = np.float32([record.y[k, 0], record.x[k, 0], record.y[k, 1], record.x[k, 1]])
        assert record.u[k].argmax() == player.act(obs, env.action_space)
    with pytest.raises(ValueError, match="shown the state of that"):
        RecordCommand("Acrobot-v1", **{**options, "measured": "0", "hidden": "1"}).run(Console())
