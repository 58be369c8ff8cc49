"""``kkl-gym agent``: episodes, user systems, any environment; tests/training/agents tests the functions behind it."""

from functools import partial

import gymnasium as gym
import linear_system
import numpy as np
import pytest
from rich.console import Console
from small_agents import make_small

from kkl_gym.compiled import SamplingStep
from kkl_gym.simulate import advance_batch
from training.agents.agent import Agent
from training.agents.learning import learn
from training.agents.tasks import HIDDEN_VELOCITIES
from training.cli import main, read
from training.commands.agent import Evaluate
from training.commands.options import PlayOptions
from training.commands.record import RecordCommand
from training.records import read_records

OWN = f"{linear_system.__file__}:Oscillator"
CART = HIDDEN_VELOCITIES["CartPole-v1"]


@pytest.fixture(autouse=True)
def _small_and_without_compilation(monkeypatch):
    monkeypatch.setattr("kkl_gym.vector.batch_step", lambda system: SamplingStep(partial(advance_batch, system)))
    make_small(monkeypatch)


def test_an_agent_is_played_on_the_episodes_of_a_seed(capsys):
    assert Evaluate("lorenz").episodes == 500
    shown = []
    for seed in ("0", "0", "1"):
        main(["agent", "evaluate", "lorenz", "--episodes", "2", "--seed", seed])
        lines = capsys.readouterr().out.splitlines()
        shown.append("\n".join(line for line in lines if " passed" not in line))  # no progress lines of slow machines
    assert "±" in shown[0]
    assert "holds the target" in shown[0]
    assert shown[0] == shown[1] != shown[2]


def test_an_agent_for_a_user_system(saved, script):
    main(["agent", "train", OWN, "--observer", saved(system=OWN), "--timesteps", "1"])
    path = "runs/agents/oscillator-x_hat-0/agent.safetensors"
    agent = Agent.read(path)
    assert (agent.observer, agent.training["algorithm"]) == (saved(system=OWN), "ppo")
    with pytest.raises(SystemExit, match=r"trust .* if you trust this code"):
        main(["agent", "evaluate", path, "--episodes", "2"])
    main(["agent", "evaluate", path, "--episodes", "2", "--trust", OWN])
    with pytest.raises(SystemExit, match="pendulum has no inputs"):
        main(["agent", "train", f"{script}:Pendulum", "--information", "y"])


@pytest.mark.parametrize("information", ["z", "recurrent", "x_hat"])
def test_an_agent_in_any_environment(information, capsys):
    steps = ["--timesteps", "300"] if information == "x_hat" else []
    main(["agent", "train", "CartPole-v1", "--information", information, "--measured", "0,2", *steps])
    main(["agent", "evaluate", f"runs/agents/CartPole-v1-{information}-0/agent.safetensors", "--episodes", "3"])
    shown = capsys.readouterr().out
    assert shown.count("return") == 2
    with pytest.raises(SystemExit, match="already holds an agent"):
        main(["agent", "train", "CartPole-v1", "--information", information])


def test_options_become_a_task(capsys):
    words = "--time-constants 1,2 --frames 4 --no-past-actions --angles 3,1 --angles 4,2 --env-kwargs a=1 b=x"
    options = read(["agent", "train", "InvertedDoublePendulum-v5", *words.split()]).command.options
    task = options.task("InvertedDoublePendulum-v5")
    assert (task.time_constants, task.frames, task.past_actions) == ((1.0, 2.0), 4, False)
    assert (task.angles, task.env_kwargs) == (((3, 1), (4, 2)), {"a": 1, "b": "x"})
    with pytest.raises(SystemExit):
        read(["agent", "train", "CartPole-v1", "--angles", "0,1,2"])
    assert "expected the entries of a cosine and a sine, as in 0, 1; got '0,1,2'" in capsys.readouterr().err


def test_an_agent_on_the_state_is_recorded_as_a_policy(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    learn(CART, "state", tmp_path)
    path = tmp_path / "agent.safetensors"
    options = {"measured": "0,2", "hidden": "1,3", "policy": str(path), "play": PlayOptions(steps=30)}
    name = RecordCommand("CartPole-v1", **options).run(Console())
    assert name == "cartpole-v1/agent-v0"
    (record, *_) = read_records((f"minari:{name}",))
    policy = Agent.read(path).policy(gym.make("CartPole-v1").action_space)
    for k in range(len(record.t) - 1):
        obs = np.float32([record.y[k, 0], record.x[k, 0], record.y[k, 1], record.x[k, 1]])
        assert record.u[k].argmax() == policy(obs[None])[0]
    with pytest.raises(ValueError, match="for Acrobot-v1 that sees state"):
        RecordCommand("Acrobot-v1", **{**options, "measured": "0", "hidden": "1"}).run(Console())
