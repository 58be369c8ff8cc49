"""Training of agents in systems and in any environment, and of their observers."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from kkl_gym import KKLVectorEnv, get_system
from observers import Artifact
from training.agents import learning
from training.agents.agent import Agent
from training.agents.information import make
from training.agents.learning import hyperparameters, learn, settings_of
from training.agents.observing import Privileged, learn_observer
from training.agents.play import play
from training.agents.policy import ALGORITHMS
from training.agents.seeds import AGENT_EVALUATION_SEED
from training.agents.tasks import HIDDEN_VELOCITIES, TASKS, Task, control_task, get_task, scores
from training.progress import ProgressBars

PENDULUM, CART = HIDDEN_VELOCITIES["Pendulum-v1"], HIDDEN_VELOCITIES["CartPole-v1"]
NOISY_CART = replace(CART, measurement_noise=0.1)
SHORT = control_task("van_der_pol", 0.2, duration=0.5)


def steps_of(records):
    return sum(len(record.t) - 1 for record in records)


def test_all_settings_are_ones_of_their_algorithm(script):
    of_the_run = {"policy", "n_envs", "n_timesteps", "normalize", "noise_type", "noise_std"}
    tasks = [*TASKS.values(), *HIDDEN_VELOCITIES.values(), Task("Other-v0", (0,)), control_task("m.py:Own")]
    for name, algorithm in ALGORITHMS.items():
        for task in tasks:
            found = hyperparameters(name, task)
            assert found["n_timesteps"] > 0
            assert set(found) <= set(algorithm.__init__.__annotations__) | of_the_run, (name, task)
    for task in HIDDEN_VELOCITIES.values():  # as many steps as the agents in the comparison
        other = "sac" if task.env_id in settings_of("sac") else "ppo"
        assert hyperparameters("ppo_lstm", task)["n_timesteps"] == hyperparameters(other, task)["n_timesteps"]
    hyperparameters("sac", PENDULUM)["policy_kwargs"]["net_arch"] = None  # changes a copy only
    assert hyperparameters("sac", PENDULUM)["policy_kwargs"]["net_arch"] == [64, 64]
    assert hyperparameters("sac", tasks[-1]) == hyperparameters("sac", TASKS["lorenz"])


@pytest.mark.parametrize(
    ("algorithm", "task", "kind"),
    [
        ("ppo", CART, "z"),
        ("a2c", PENDULUM, "traces"),
        ("dqn", CART, "state"),
        ("sac", PENDULUM, "stacked"),
        ("td3", PENDULUM, "y"),
        ("ppo_lstm", CART, "recurrent"),
        ("ppo", SHORT, "state"),
        ("sac", SHORT, "x_hat_std"),
        ("ppo_lstm", SHORT, "recurrent"),
    ],
)
def test_a_file_acts_as_the_agent_that_was_trained(tmp_path, small, monkeypatch, algorithm, task, kind):
    models, original = [], learning.agent_of

    def kept(model, *arguments, **options):
        models.append(model)
        return original(model, *arguments, **options)

    monkeypatch.setattr(learning, "agent_of", kept)
    learn(task, kind, tmp_path, algorithm=algorithm)
    (model,) = models
    agent, scaling = Agent.read(tmp_path / "agent.safetensors"), model.get_vec_normalize_env()
    env = agent.make(2)
    policy, state = agent.policy(env.single_action_space), None
    obs, _ = env.reset(seed=3)
    starts = np.ones(2, dtype=bool)
    for _ in range(7):
        scaled = obs if scaling is None else scaling.normalize_obs(obs)
        expected, state = model.predict(scaled, state, starts, deterministic=True)
        action, starts = policy(obs), np.zeros(2, dtype=bool)
        np.testing.assert_allclose(action, expected, atol=1e-5)
        obs, *_ = env.step(action)
    assert agent.training["algorithm"] == algorithm
    assert list(pd.read_csv(tmp_path / "curve.csv")) == ["steps", "seconds", "return"]


def test_seeds_make_agents_and_never_the_episodes_of_the_evaluation(tmp_path, small, monkeypatch):
    """Each agent has its own seeds, although stable-baselines3 seeds environments when it makes a model."""
    seeds, reset = [], KKLVectorEnv.reset

    def noted(self, *, seed=None, options=None):
        seeds.append(seed)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(KKLVectorEnv, "reset", noted)
    agents = [learn(SHORT, "y", tmp_path / name, seed=seed) for name, seed in (("a", 1), ("b", 1), ("c", 2))]
    one, same, other = (agent.network.weights[0] for agent in agents)
    assert (one == same).all()
    assert (one != other).any()
    first, again, second = (set(given) for given in seeds if isinstance(given, list))
    assert first == again
    assert not first & second
    assert not (first | second) & set(range(AGENT_EVALUATION_SEED, AGENT_EVALUATION_SEED + 10_000))


def test_an_agent_on_estimates_sees_hidden_signals_until_there_are_estimates(tmp_path, small):
    agent = learn(CART, "x_hat", tmp_path, timesteps=300, observer_steps=200)
    assert 300 <= agent.training["timesteps"] < 400
    curve = pd.read_csv(tmp_path / "curve.csv")
    assert curve.steps.min() < 200 < curve.steps.max()


def test_z_under_noise_has_only_predictive_features(tmp_path, small):
    task = replace(PENDULUM, measurement_noise=0.1, angles=((0, 1),))
    agent = learn(task, "z", tmp_path, algorithm="ppo", timesteps=3_000, observer_steps=300, seed=1)
    again = Agent.read(tmp_path / "agent.safetensors")
    assert again.task == agent.task == replace(task, weights=agent.task.weights)
    (here, _), (there, _) = (one.make(2).reset(seed=3) for one in (agent, again))
    np.testing.assert_array_equal(here, there)
    assert here.shape[1] < learn(task, "z", tmp_path, algorithm="ppo").inputs == 8


@pytest.mark.parametrize(
    ("task", "algorithm", "timesteps", "aggregate", "first"),
    [
        (CART, "ppo", 320, 1, 288 + 2),  # stops at the first step of the next rollout
        (CART, "ppo", 98, 0, 64 + 2),  # the third rollout has estimates
        (PENDULUM, "sac", 97, 1, 87 + 1),
        (NOISY_CART, "ppo", 320, 1, 32),
    ],
)
def test_number_of_steps_before_an_observer_is_learned(
    tmp_path, small, monkeypatch, task, algorithm, timesteps, aggregate, first
):
    fitted = []

    def noted(task, records, **options):
        fitted.extend(records)
        raise StopIteration

    monkeypatch.setattr(learning, "learn_observer", noted)
    with pytest.raises(StopIteration):
        learn(task, "x_hat", tmp_path, algorithm=algorithm, timesteps=timesteps, aggregate=aggregate)
    assert steps_of(fitted) == first


@pytest.mark.parametrize("task", [CART, PENDULUM], ids=["no bounds", "bounds"])
def test_hidden_signals_take_the_place_of_later_estimates(tmp_path, small, task):
    privileged = Privileged(task, 1)
    env = privileged.make()
    env.reset(seed=0)
    for _ in range(250):
        env.step(env.action_space.sample())
    records = privileged.records()
    assert steps_of(records) == 250
    path = learn_observer(task, records, tmp_path, seed=0, progress=ProgressBars(None))
    truth, _ = env.reset(seed=3)
    _, info = make(task, "x_hat", 1, observer=str(path)).reset(seed=3)
    np.testing.assert_allclose(truth, np.concatenate([info["y"], info["x"]], axis=1), rtol=1e-6)
    z = make(task, "z", 1, observer=str(path))
    obs, info = z.reset(seed=3)
    np.testing.assert_allclose(obs[:, : len(task.measured)], info["y"], rtol=1e-6)


@pytest.mark.parametrize("task", [CART, NOISY_CART])
def test_short_episodes_are_no_error(tmp_path, small, task):
    """Neither as the last episode nor if the longest episode is held out, as with this seed."""
    options = {"algorithm": "dqn", "timesteps": 600, "observer_steps": 300, "aggregate": 1, "seed": 11}
    agent = learn(task, "x_hat", tmp_path, **options)
    assert agent.observer == str(tmp_path / "observer.safetensors")
    assert agent.make().reset(seed=0)[0].shape == (1, 4)  # two positions, two estimates
    options = {"observer": agent.observer, "algorithm": "dqn", "timesteps": 12, "aggregate": 1}
    with pytest.warns(UserWarning, match="the observer in use stays"):
        given = learn(task, "x_hat", tmp_path / "given", **options)
    assert given.observer == str(tmp_path / "given" / "observer.safetensors")  # although no refit was possible


def test_an_observer_is_refitted_to_the_agents_own_episodes(tmp_path, small, monkeypatch):
    task, first = replace(PENDULUM, measurement_noise=0.1), []

    def noted(*arguments, **options):
        path = learn_observer(*arguments, **options)
        first.append(Artifact.read(path))
        return path

    options = {"algorithm": "ppo", "timesteps": 1200, "observer_steps": 400, "aggregate": 1, "seed": 1}
    monkeypatch.setattr(learning, "learn_observer", noted)
    learn(task, "x_hat", tmp_path, **options)
    path = tmp_path / "observer.safetensors"
    artifact = Artifact.read(path)
    assert artifact.training["held_out_errors"] != first[0].training["held_out_errors"]  # a refit replaced the observer
    assert artifact.signals["hidden"] == ["info[clean][0]", "info[clean][1]", "info[clean][2]"]
    assert artifact.signals["measured"] == ["obs[0]", "obs[1]"]
    obs, info = make(task, "x_hat", 2, observer=str(path)).reset(seed=0)
    assert obs.shape == (2, 3)
    np.testing.assert_array_equal(info["x"], info["clean"])
    assert not np.allclose(info["y"], info["clean_y"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"information": "z", "aggregate": 2}, "aggregate needs x_hat or x_hat_std, and no system"),
        ({"information": "recurrent", "algorithm": "ppo"}, "recurrent agents learn by ppo_lstm"),
        ({"information": "x_hat_std"}, "a trained observer with error bars"),
        ({"information": "x_hat", "timesteps": 4}, r"4 steps are too few .*--timesteps"),
        ({"information": "z", "algorithm": "reinforce"}, "unknown algorithm"),
        ({"information": "y", "algorithm": "dqn"}, "take ppo, a2c, sac"),
        ({"task": replace(CART, measured=(0, 1, 2, 3)), "information": "x_hat"}, "nothing is left to estimate"),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, small, options, message):
    task, information = options.pop("task", PENDULUM), options.pop("information")
    with pytest.raises(ValueError, match=message):
        learn(task, information, tmp_path, **options)


@pytest.mark.slow
def test_an_agent_learns(tmp_path):
    """Half a minute of PPO on the full state of Van der Pol's oscillator."""
    agent = learn(get_task("van_der_pol"), "state", tmp_path, timesteps=200_000)
    env = agent.make(50)
    x = play(env, agent.policy(env.single_action_space), seed=0).x
    assert scores(get_system("van_der_pol"), x).mean() > -0.25
