"""The control tasks for programs that train on single environments, such as rl-zoo3."""

from dataclasses import replace
from importlib.resources import files

import gymnasium as gym
import numpy as np
import pytest
import yaml

from kkl_gym import ENV_IDS
from training.agents import OnTask
from training.agents.agent import Agent, find
from training.agents.cost import MAX_COST, Cost
from training.agents.information import make
from training.agents.play import play
from training.agents.tasks import TASKS


def settings(algorithm, name):
    text = files("training.agents").joinpath("hyperparameters", f"{algorithm}.yml").read_text()
    return yaml.safe_load(text)[ENV_IDS[name]]


@pytest.mark.parametrize(("name", "x0"), [("van_der_pol", None), ("rossler", [-44.0, -17.0, 212.0])])
def test_one_environment_is_a_row_of_the_task(name, x0):
    """Observations and rewards are equal, with the environment made as by rl-zoo3; the motion from x0 escapes."""
    one = OnTask(gym.make(ENV_IDS[name], **settings("ppo", name)["env_kwargs"]))
    rows = Cost(make(TASKS[name], "x_hat", 2, observer=name), TASKS[name])
    options = None if x0 is None else {"x0": x0}
    obs, _ = one.reset(seed=4, options=options)
    expected, _ = rows.reset(seed=[4, 5], options=options)
    np.testing.assert_allclose(obs, expected[0], rtol=1e-5, atol=1e-6)
    assert obs in one.observation_space
    rng, ended, done = np.random.default_rng(0), False, 0
    while done < (15 if x0 is None else 100) and not ended:
        done += 1
        action = rng.uniform(-1, 1, (2, *one.action_space.shape)).astype(np.float32)
        obs, reward, ended, truncated, _ = one.step(action[0])
        expected, paid, terminated, truncated_rows, info = rows.step(action)
        np.testing.assert_allclose(obs, (info["final_obs"] if ended else expected)[0], rtol=1e-4, atol=1e-5)
        assert reward == pytest.approx(paid[0], rel=1e-5)
        assert (ended, truncated) == (terminated[0], truncated_rows[0])
    assert ended == (x0 is not None)
    if ended:  # the reward covers the rest of the episode
        assert reward == -MAX_COST * (TASKS[name].steps - done + 1)


def test_the_settings_for_rl_zoo3_make_our_task():
    for name, task in TASKS.items():
        for algorithm in ("ppo", "sac"):
            found = settings(algorithm, name)
            assert found["env_wrapper"] == "training.agents.OnTask"
            env = gym.make(ENV_IDS[name], **found["env_kwargs"])
            plant = env.unwrapped.plant
            assert env.spec.max_episode_steps == task.steps * task.repeat == task.env_kwargs["max_episode_steps"]
            assert (plant.dt, plant.measurement_noise) == (task.env_kwargs["dt"], task.measurement_noise)
            np.testing.assert_array_equal(plant.start_box, np.transpose(task.env_kwargs["start_box"] or plant.system.X))


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in TASKS if name != "lorenz"]


@pytest.mark.parametrize("name", ["lorenz", *SLOW])
def test_the_shipped_agent_reaches_the_reward_threshold(name):
    """On the registered environment, with the period of the agent's task; zero input stays below the threshold."""
    agent, spec = Agent.read(find(name)), gym.spec(ENV_IDS[name])
    options = {**agent.task.env_kwargs, "start_box": None, "max_episode_steps": spec.max_episode_steps}
    env = make(replace(agent.task, env_kwargs=options), "x_hat", 8, observer=agent.observer)
    for act, reached in (
        (agent.policy(env.single_action_space), True),
        (lambda obs: np.zeros((len(obs), 1)), False),
    ):
        assert (play(env, act, seed=70_000).returns.mean() > spec.reward_threshold) == reached


def test_refusals():
    with pytest.raises(ValueError, match="OnTask needs an environment of a system"):
        OnTask(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match=r"has dt = 0.02 s, but its task 0.01 s"):
        OnTask(gym.make("KKLLorenz-v0", dt=0.02))


def test_the_specification_recreates_the_wrapper(saved):
    env = OnTask(gym.make("KKLVanDerPol-v0"), observer=saved())
    again = gym.make(env.spec)
    assert isinstance(again, OnTask)
    assert (again.reset(seed=1)[0] == env.reset(seed=1)[0]).all()
