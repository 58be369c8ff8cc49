"""Export to and import from stable-baselines3: actions are the same, and nothing is unpickled."""

import pickle
import zipfile
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

from training.agents import OnTask
from training.agents.agent import Agent, AgentError, find
from training.agents.learning import learn
from training.agents.policy import ALGORITHMS
from training.agents.sb3_files import from_sb3, to_sb3
from training.agents.tasks import HIDDEN_VELOCITIES, TASKS
from training.cli import main

PENDULUM, CART = HIDDEN_VELOCITIES["Pendulum-v1"], HIDDEN_VELOCITIES["CartPole-v1"]


def actions(agent, obs):
    return agent.policy(agent.make().single_action_space)(obs)


@pytest.mark.parametrize("name", ["reverse_duffing", "lorenz"])  # trained by SAC and PPO
def test_there_and_back(name, tmp_path):
    agent, path = Agent.read(find(name)), tmp_path / "agent.zip"
    main(["agent", "export", name, "--out", str(path)])
    played = ALGORITHMS[agent.training["algorithm"]].load(path, device="cpu")
    obs = np.random.default_rng(0).normal(size=(50, agent.inputs)).astype(np.float32)
    np.testing.assert_allclose(played.predict(obs, deterministic=True)[0], actions(agent, obs), atol=1e-5)
    back = tmp_path / "agent.safetensors"
    main(["agent", "import", str(path), name, "--out", str(back), "--observer", agent.observer])
    again = Agent.read(back)
    assert (again.task, again.observer, again.fingerprint) == (agent.task, agent.observer, agent.fingerprint)
    assert again.network.activation == agent.network.activation
    assert (actions(again, obs) == actions(agent, obs)).all()


@pytest.mark.parametrize(
    ("algorithm", "task", "information"),
    [
        ("ppo", CART, "z"),
        ("a2c", PENDULUM, "traces"),
        ("dqn", CART, "y"),
        ("sac", PENDULUM, "y"),
        ("td3", PENDULUM, "state"),
        ("tqc", PENDULUM, "stacked"),
        ("ppo_lstm", CART, "recurrent"),
    ],
)
def test_agents_in_any_environment_there_and_back(algorithm, task, information, tmp_path, small):
    agent = learn(task, information, tmp_path, algorithm=algorithm, timesteps=40)
    to_sb3(agent).save(tmp_path / "agent.zip")
    again = from_sb3(tmp_path / "agent.zip", task, information)
    assert again.mean is None  # the first layer includes the scaling
    env = agent.make(5)
    policies = [one.policy(env.single_action_space) for one in (agent, again)]
    obs, _ = env.reset(seed=0)
    for _ in range(5):
        here, there = (policy(obs) for policy in policies)
        np.testing.assert_allclose(there, here, atol=1e-4)
        obs, *_ = env.step(here)
    assert ALGORITHMS[algorithm].load(tmp_path / "agent.zip", device="cpu").predict(obs)[0].shape[0] == 5


class _Bomb:
    def __reduce__(self):
        return exec, ("raise SystemExit('unpickled')",)


@pytest.fixture
def trained(tmp_path):
    """The file of an untrained SAC agent with SAC's default activation."""
    env = OnTask(gym.make("KKLRossler-v0"))
    SAC("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, buffer_size=1, device="cpu").save(tmp_path / "agent.zip")
    return tmp_path / "agent.zip"


@pytest.mark.parametrize(("parts", "match"), [
    ({"policy.pth": pickle.dumps(_Bomb(), protocol=2)}, "not an agent of stable-baselines3: Weights only load failed"),
    ({"policy.pth": None}, r"not an agent of stable-baselines3: .*policy.pth"),
    ({"data": b'{"policy_kwargs": {"activation_fn": "<class \'torch.nn.ELU\'>"}}'}, "activation .*ELU.* is unknown"),
    ({"data": b"{"}, "agent.zip"),
])  # fmt: skip
def test_invalid_files_are_refused(parts, match, trained):
    with zipfile.ZipFile(trained) as files:
        held = {name: files.read(name) for name in files.namelist()}
    with zipfile.ZipFile(trained, "w") as files:
        for name, content in (held | parts).items():
            if content is not None:
                files.writestr(name, content)
    with pytest.raises(AgentError, match=match):
        from_sb3(trained, TASKS["rossler"])


def test_files_that_are_something_else(tmp_path, trained):
    assert from_sb3(trained, TASKS["rossler"]).network.activation == "relu"  # SAC's default
    with pytest.raises(AgentError, match=r"missing\.zip: it cannot be read: No such file"):
        from_sb3(tmp_path / "missing.zip", TASKS["rossler"])
    with pytest.raises(AgentError, match="the policy has 3 inputs and 1 outputs, but the environment"):
        from_sb3(trained, TASKS["van_der_pol"])
    strange = replace(Agent.read(find("lorenz")), training={"algorithm": "reinforce"})
    with pytest.raises(AgentError, match=r"algorithm must be one of .* got 'reinforce'"):
        to_sb3(strange)
