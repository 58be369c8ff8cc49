"""Files of agents in any environment, and the commands that train, play and record them."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from observers import MLP
from training.agents.agent import AgentError
from training.agents.any_environment.learning import learn_to_play
from training.agents.any_environment.player import Player
from training.agents.any_environment.task import HIDDEN_VELOCITIES, HiddenTask
from training.commands.agent import Evaluate, Train
from training.commands.environment import EnvironmentOptions
from training.commands.record import PlayOptions, RecordCommand
from training.records import read_records

PENDULUM = HIDDEN_VELOCITIES["Pendulum-v1"]
CART = HIDDEN_VELOCITIES["CartPole-v1"]


def player(inputs=2, **changes):
    network = MLP([np.zeros((1, inputs))], [np.zeros(1)], "tanh")
    return Player(**{"network": network, "head": "clip", "task": PENDULUM, "information": "y", **changes})


@pytest.mark.parametrize("changes", [{"time_constants": (1, 2)}, {"angles": ((0, 1),), "frames": 4}])
def test_a_file_holds_the_task(changes, tmp_path):
    task = replace(PENDULUM, **changes)
    player(task=task, information="z", inputs=8).save(tmp_path / "agent.safetensors")
    found = Player.read(tmp_path / "agent.safetensors")
    assert found.task == task
    assert found.make().observation_space.shape == (8,)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"head": "softmax"}, "head"),
        ({"information": "everything"}, "information"),
        ({"observer": 3}, "observer must be a string"),
        ({"mean": np.zeros(2)}, "belong together"),
        ({"mean": np.zeros(2), "scale": np.array([1.0, np.nan])}, "2 finite numbers"),
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
    for named in (None, "Pendulum-v1"):
        with pytest.raises(AgentError, match="if you trust"):
            found.make(env_id=named)
    with pytest.raises(ValueError, match="no_such_module"):
        found.make(env_id="no_such_module:Evil-v0")


def test_damaged_and_foreign_files_are_refused(tmp_path):
    path = tmp_path / "agent.safetensors"
    player().save(path)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(AgentError, match="damaged"):
        Player.read(path)
    with pytest.raises(AgentError, match="no file"):
        Player.read(tmp_path / "none.safetensors")


def test_the_commands_train_and_play(tmp_path, small, capsys):
    options = EnvironmentOptions(measured="0,2")
    Train("CartPole-v1", "z", out=tmp_path, environment=options).run(Console(width=100))
    Evaluate(str(tmp_path / "agent.safetensors"), episodes=3).run(Console(width=100))
    shown = capsys.readouterr().out
    assert "CartPole-v1" in shown
    assert shown.count("return") == 2
    with pytest.raises(FileExistsError, match="holds an agent already"):
        Train("CartPole-v1", "z", out=tmp_path).run(Console())


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("CartPole-v1", {"resume": True}, "leave --resume out"),
        ("CartPole-v1", {"measurement_noise": (0.1, 0.2)}, "one number"),
        ("Acrobot-v1", {}, "say what is measured of Acrobot-v1"),
        ("lorenz", {"information": "recurrent"}, "a system knows"),
        ("lorenz", {"environment": EnvironmentOptions(frames=2)}, "--frames: this is for agents in an environment"),
    ],
)
def test_commands_that_make_no_sense(name, options, says, tmp_path):
    with pytest.raises(ValueError, match=says):
        Train(name, **{"information": "z", **options}, out=tmp_path / "a").run(Console())


def test_options_become_a_task():
    options = {"time_constants": "1,2", "frames": 4, "no_past_actions": True, "angles": ("3,1", "4,2")}
    task = EnvironmentOptions(**options).task("InvertedDoublePendulum-v5")
    assert (task.time_constants, task.frames, task.past_actions) == ((1.0, 2.0), 4, False)
    assert task.angles == ((3, 1), (4, 2))
    for wrong, says in (
        ({"measured": "x"}, "takes indices"),
        ({"time_constants": "1;2"}, "--time-constants takes numbers of steps"),
        ({"angles": ("cos",)}, "--angles takes indices"),
        ({"angles": ("0,1,2",)}, r"--angles takes the cosine's entry and the sine's, .* got '0,1,2'"),
        ({"angles": ("0,1",)}, r"angles must name entries of CartPole-v1 that are measured, \(0, 2\)"),
    ):
        with pytest.raises(ValueError, match=says):
            EnvironmentOptions(**wrong).task("CartPole-v1")


def test_an_agent_on_the_state_is_recorded_as_a_policy(tmp_path, small, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    learn_to_play(CART, "state", tmp_path)
    path = tmp_path / "agent.safetensors"
    options = {"measured": "0,2", "hidden": "1,3", "policy": str(path), "play": PlayOptions(steps=30)}
    name = RecordCommand("CartPole-v1", **options).run(Console())
    assert name == "cartpole-v1/agent-v0"
    (record, *_) = read_records((f"minari:{name}",))
    policy, env = Player.read(path), gym.make("CartPole-v1")
    for k in range(len(record.t) - 1):
        obs = np.float32([record.y[k, 0], record.x[k, 0], record.y[k, 1], record.x[k, 1]])
        assert record.u[k].argmax() == policy.act(obs, env.action_space)
    with pytest.raises(ValueError, match="shown the state of that"):
        RecordCommand("Acrobot-v1", **{**options, "measured": "0", "hidden": "1"}).run(Console())
