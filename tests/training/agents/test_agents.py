"""Training, saving and playing agents, at toy size."""

import json
import os
import re
import shutil
from dataclasses import replace

import linear_system
import numpy as np
import pytest
import torch
from linear_system import Oscillator
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import save as serialise
from safetensors_bytes import with_arrays
from stable_baselines3 import PPO, SAC

from kkl_gym import get_system
from observers import MLP
from training import figures
from training.agents import SB3VecEnv, picture
from training.agents.agent import Agent, AgentError, fingerprint, rules
from training.agents.cost import WORST, Cost
from training.agents.learn import hyperparameters, learn, learn_recurrent
from training.agents.play import play
from training.agents.tasks import TASKS, ControlTask, get_task, scores
from training.cli import main
from training.commands.agent import find
from training.seeds import AGENT_EVALUATION_SEED

TASK = ControlTask("van_der_pol", measurement_noise=0.2, duration=0.5)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    return learn(TASK, "x_hat", folder, timesteps=1, seed=1), folder


@pytest.mark.parametrize(("algorithm", "kind"), [("ppo", PPO), ("sac", SAC)])
def test_the_policy_is_that_of_stable_baselines3(algorithm, kind, tmp_path, monkeypatch):
    models = []
    original = kind.learn

    def keep(self, timesteps, **options):
        models.append(self)
        return original(self, timesteps, **options)

    monkeypatch.setattr(kind, "learn", keep)
    task = TASKS["van_der_pol" if algorithm == "ppo" else "reverse_duffing"]
    agent = learn(task, "state", tmp_path, timesteps=1, algorithm=algorithm)
    obs = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    expected, _ = models[0].predict(obs, deterministic=True)
    assert np.allclose(agent(obs), expected, atol=1e-5)
    assert np.abs(agent(100 * obs)).max() <= 1.0


def test_equal_seeds_give_equal_agents(learned, tmp_path):
    agent, _ = learned
    again = learn(TASK, "x_hat", tmp_path / "a", timesteps=1, seed=1)
    other = learn(TASK, "x_hat", tmp_path / "b", timesteps=1, seed=2)
    obs = np.ones((1, 2), np.float32)
    assert np.array_equal(again(obs), agent(obs))
    assert not np.array_equal(other(obs), agent(obs))


def test_a_saved_agent_plays_the_same(learned):
    agent, folder = learned
    read = Agent.read(folder / "agent.safetensors")
    assert (read.task, read.information, read.observer) == (TASK, "x_hat", "van_der_pol")
    assert read.fingerprint == fingerprint("van_der_pol")
    assert (read.training["algorithm"], read.training["seed"], read.training["timesteps"]) == ("ppo", 1, 256 * 32)
    assert "rollout/ep_rew_mean" in (folder / "progress.csv").read_text().splitlines()[0]
    episodes = [play(one.make(4), one, steps=TASK.steps, seed=0) for one in (agent, read)]
    assert np.array_equal(episodes[0].x, episodes[1].x)
    assert episodes[0].x_hat.shape == episodes[0].x.shape == (TASK.steps + 1, 4, 2)


def test_a_task_with_starts_of_its_own_survives_saving(learned, tmp_path):
    agent, _ = learned
    whole = replace(agent, task=TASKS["van_der_pol"], information="state")
    whole.save(tmp_path / "a.safetensors")
    assert Agent.read(tmp_path / "a.safetensors").task == TASKS["van_der_pol"]


def test_levels_of_noise_of_each_output_survive_saving(learned, tmp_path):
    agent, _ = learned
    task = get_task(f"{linear_system.__file__}:TwoOutputs")
    assert task.measurement_noise == (0.1, 0.3)
    other = get_task(f"{linear_system.__file__}:TwoOutputs", (0.2, 0.4))
    replace(agent, task=other, information="state", observer=None, rules=rules(other)).save(tmp_path / "a.safetensors")
    assert Agent.read(tmp_path / "a.safetensors").task == replace(task, measurement_noise=(0.2, 0.4))


def test_mismatches_are_errors(learned, saved, tmp_path):
    agent, _ = learned
    path = tmp_path / "map.safetensors"
    shutil.copy(saved(system="van_der_pol"), path)
    own = replace(agent, observer=str(path), fingerprint=fingerprint(str(path)))
    assert own.make(1)
    shutil.copy(saved(system="van_der_pol", noise=False), path)
    with pytest.raises(AgentError, match="is not the one that the agent was trained on: its file has changed"):
        own.make(1)
    path.unlink()
    with pytest.raises(AgentError, match="observer cannot be read"):
        own.make(1)
    with pytest.raises(AgentError, match="must name its observer"):
        replace(agent, observer=None).make(1)
    with pytest.raises(AgentError, match="trained with target = "):
        replace(agent, rules={**agent.rules, "target": [1.0, 1.0]}).make(1)
    lorenz = replace(agent, task=TASKS["lorenz"], information="state", observer=None, rules=rules(TASKS["lorenz"]))
    with pytest.raises(AgentError, match="2 inputs and 1 outputs"):
        lorenz.make(1)


def test_damaged_and_foreign_files(learned, saved, tmp_path):
    _, folder = learned
    with safe_open(folder / "agent.safetensors", framework="numpy") as opened:
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        text = opened.metadata()["kkl-gym-agent"]
    key, content = "kkl-gym-agent", (folder / "agent.safetensors").read_bytes()
    cases = {
        "truncated": (content[:-7], "damaged"),
        "empty": (b"", "damaged"),
        "unsealed": (serialise(tensors, metadata={key: text}), "lacks its checksum, the metadata kkl-gym-agent-sha256"),
        "newer": (with_arrays(tensors, key, text.replace('"format": 1', '"format": 9')), "another format"),
        "incomplete": (with_arrays(tensors, key, text.replace("squashed", "squished")), "incomplete"),
        "unknown": (with_arrays(tensors, key, text.replace("x_hat", "x_hut")), "knows one of state, .* got 'x_hut'"),
    }
    for name, (changed, match) in cases.items():
        assert changed != content
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(changed)
        with pytest.raises(AgentError, match=match):
            Agent.read(path)
    with pytest.raises(AgentError, match="is not an agent of kkl-gym"):
        Agent.read(saved())
    with pytest.raises(AgentError, match="there is no file"):
        Agent.read(tmp_path / "none.safetensors")
    with pytest.raises(AgentError, match="no agent 'nothing' ships"):
        find("nothing")


@pytest.fixture
def parts():
    """Tensors and description of a shipped agent, to be written again changed."""
    with safe_open(find("lorenz"), framework="numpy") as opened:
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        return tensors, json.loads(opened.metadata()["kkl-gym-agent"])


@pytest.mark.parametrize("change", [
    lambda t, d: t.update({"0.weight": t["0.weight"].astype(np.int64)}),
    lambda t, d: t.update({"0.bias": t["0.bias"] > 0}),
    lambda t, d: t.update({"0.bias": np.full_like(t["0.bias"], np.nan)}),
    lambda t, d: t.pop("1.bias"),
    lambda t, d: t.clear(),
    lambda t, d: d.update(activation=["tanh"]),
    lambda t, d: d.update(squashed="false"),
    lambda t, d: d.update(squashed=0),
    lambda t, d: d.update(task=[]),
    lambda t, d: d["task"].update(start_box=3),
    lambda t, d: d["task"].update(period="0.05"),
    lambda t, d: d.update(invented=1),
    lambda t, d: d.update(information=["x_hat"]),
    lambda t, d: d.update(format="1"),
    lambda t, d: d.pop("activation"),
    lambda t, d: d["task"].update(system=3),
    lambda t, d: d["task"].update(duration=float("inf")),
    lambda t, d: d.update(observer=3),
    lambda t, d: d.update(observer=["lorenz"]),
    lambda t, d: d.update(fingerprint=3),
    lambda t, d: d.update(rules=[]),
    lambda t, d: d.update(training="sac"),
    lambda t, d: d["training"].update(seed="x/../../out"),
    lambda t, d: d["training"].update(seed=1.0),
    lambda t, d: d["training"].update(seed=True),
    lambda t, d: d["training"].update(seed=None),
])  # fmt: skip
def test_contents_that_make_no_agent(change, parts, tmp_path):
    tensors, described = parts
    change(tensors, described)
    path = tmp_path / "agent.safetensors"
    path.write_bytes(with_arrays(tensors, "kkl-gym-agent", described))
    with pytest.raises(AgentError, match=re.escape(str(path))):
        Agent.read(path)


def test_a_pipe_for_an_observer_is_not_waited_for(learned, tmp_path):
    agent, _ = learned
    os.mkfifo(tmp_path / "map.safetensors")
    stranger = replace(agent, observer=str(tmp_path / "map.safetensors"))
    with pytest.raises(
        AgentError, match=r"observer cannot be read: .*map\.safetensors is a folder, a pipe or a device"
    ):
        stranger.make(1)


@pytest.fixture(scope="module")
def own():
    """An agent for a system that does not ship."""
    task = replace(TASK, system=f"{linear_system.__file__}:Oscillator")
    network = MLP([np.zeros((1, 2))], [np.zeros(1)], "tanh")
    return Agent(network=network, squashed=False, task=task, information="state", rules=rules(task))


def test_a_system_that_does_not_ship_is_imported_only_if_the_caller_names_it(own, tmp_path):
    evil = tmp_path / "evil.py"
    evil.write_text("open('ran', 'w')\nclass Evil: pass\n")
    named = f"{evil}:Evil"
    stranger = replace(own, task=replace(own.task, system=named))
    for trusted in (None, own.task.system, "van_der_pol", "evil.py:Evil"):
        with pytest.raises(
            AgentError, match=re.escape(f"the agent's system is {named!r}, and system={trusted!r}: give")
        ):
            stranger.make(1, system=trusted)
    assert os.listdir(tmp_path) == ["evil.py"]
    for trusted in (Oscillator, Oscillator()):  # what the file names is not asked
        env = stranger.make(1, system=trusted)
        assert env.unwrapped.system == Oscillator()
    assert os.listdir(tmp_path) == ["evil.py"]


def test_a_system_may_be_given_by_name_as_a_class_or_itself(own, tmp_path):
    own.save(tmp_path / "own.safetensors")
    agent = Agent.read(tmp_path / "own.safetensors")
    for trusted in (agent.task.system, linear_system.Oscillator, linear_system.Oscillator()):
        assert play(agent.make(2, system=trusted), agent, steps=2, seed=0).x.shape == (3, 2, 2)
    with pytest.raises(AgentError, match="trained with equations = "):
        agent.make(1, system=get_system("van_der_pol"))
    with pytest.raises(ValueError, match="got 3"):
        agent.make(1, system=3)


def test_shipped_systems_need_no_trust_but_a_wrong_name_is_an_error(learned):
    agent, _ = learned
    for system in (None, "van_der_pol", get_system("van_der_pol")):
        assert agent.make(1, system=system)
    with pytest.raises(AgentError, match="the agent's system is 'van_der_pol', and system='lorenz'"):
        agent.make(1, system="lorenz")


def test_metadata_nested_without_end(tmp_path):
    path = tmp_path / "agent.safetensors"
    path.write_bytes(with_arrays({"0.weight": np.ones((1, 1))}, "kkl-gym-agent", "[" * 100_000))
    with pytest.raises(AgentError, match=re.escape(str(path))):
        Agent.read(path)


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol", "van_der_pol-y", "rossler", "lorenz"])
def test_shipped_files_are_written_again_as_they_are(name, tmp_path):
    Agent.read(find(name)).save(tmp_path / "new" / "agent.safetensors")
    assert (tmp_path / "new" / "agent.safetensors").read_bytes() == find(name).read_bytes()
    assert os.listdir(tmp_path / "new") == ["agent.safetensors"]


def test_an_interrupted_save_leaves_nothing_behind(tmp_path, monkeypatch):
    def fail(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(KeyboardInterrupt):
        Agent.read(find("lorenz")).save(tmp_path / "agent.safetensors")
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "ppo_lstm"])
def test_training_never_sees_the_episodes_of_the_evaluation(algorithm, tmp_path, monkeypatch):
    """stable-baselines3 seeds environments when a model is made; each agent has seeds of its own all the same."""
    seeds = []
    reset = SB3VecEnv.reset

    def keep(self):
        seeds.append(list(self._seeds))
        return reset(self)

    monkeypatch.setattr(SB3VecEnv, "reset", keep)
    task = TASKS["reverse_duffing"]
    for seed in (0, 1):
        if algorithm == "ppo_lstm":
            learn_recurrent(task, "y", tmp_path / str(seed), seed=seed, timesteps=1)
        else:
            learn(task, "y", tmp_path / str(seed), seed=seed, timesteps=1, algorithm=algorithm)
    first, second = seeds
    evaluation = range(AGENT_EVALUATION_SEED, AGENT_EVALUATION_SEED + 10_000)
    assert not set(first) & set(second)
    assert not any(one in evaluation for one in (*first, *second))


def test_rewards_are_minus_the_cost_and_escaping_never_pays():
    task = ControlTask("rossler", period=0.05, duration=20.0, start_box=((-44, -44), (-17, -17), (212, 212)))
    ours, bare = Cost(task.make(1), task), task.make(1)
    ours.reset(seed=0)
    bare.reset(seed=0)
    rewards = []
    for _ in range(task.steps):
        _, reward, terminated, _, info = ours.step(np.zeros((1, 1)))
        _, total, *_ = bare.step(np.zeros((1, 1)))
        rewards.append(reward[0])
        if terminated[0]:
            break
        assert reward[0] == pytest.approx(-min((task.repeat / total[0] - 1) / 4, WORST))
    assert terminated[0]
    done = len(rewards)
    assert done == np.ceil(info["final_info"]["sample"][0] / task.repeat)
    assert rewards[-1] == -WORST * (task.steps - done + 1)  # as if it stayed there


def test_hyperparameters():
    assert hyperparameters(TASKS["reverse_duffing"])[0] == "sac"
    assert hyperparameters(TASKS["lorenz"])[0] == "ppo"
    assert hyperparameters(TASKS["reverse_duffing"], "ppo")[0] == "ppo"
    for algorithm in ("ppo", "sac", "ppo_lstm"):  # any of them for any system
        for task in TASKS.values():
            assert hyperparameters(task, algorithm)[1]["n_timesteps"] >= 100_000
    assert hyperparameters(TASKS["lorenz"], "sac") == hyperparameters(TASKS["reverse_duffing"])
    with pytest.raises(ValueError, match="unknown algorithm 'dqn'"):
        hyperparameters(TASKS["lorenz"], "dqn")
    with pytest.raises(ValueError, match="algorithm must be one of ppo, sac"):
        learn(TASKS["lorenz"], "y", None, algorithm="ppo_lstm")
    with pytest.raises(ValueError, match="timesteps must be positive"):
        learn(TASKS["lorenz"], "y", None, timesteps=0)


def test_own_systems_get_the_defaults(script):
    task = ControlTask(f"{script}:Pendulum")
    assert hyperparameters(task)[0] == "ppo"
    assert hyperparameters(task, "sac") == hyperparameters(TASKS["reverse_duffing"])


def test_a_recurrent_policy_remembers_and_begins_anew(tmp_path):
    policy = learn_recurrent(TASK, "y", tmp_path, timesteps=1)
    obs = np.ones((3, 2), np.float32)  # y and the action before
    first = policy()
    one, two = first(obs), first(obs)
    assert one.shape == (3, 1)
    assert not np.allclose(one, two)
    again = policy()
    assert np.array_equal(again(obs), one)


@pytest.mark.slow
def test_an_agent_learns():
    """Half a minute of PPO on the full state of Van der Pol."""
    import tempfile
    from pathlib import Path

    torch.set_num_threads(2)
    task = TASKS["van_der_pol"]
    with tempfile.TemporaryDirectory() as folder:
        agent = learn(task, "state", Path(folder), timesteps=200_000)
    x = play(agent.make(50), agent, steps=task.steps, seed=0).x
    assert scores(get_system(task.system), x).mean() > -0.25


def test_the_command_trains_and_evaluates(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["agent", "train", "lorenz", "--information", "y", "--timesteps", "1"])
    folder = tmp_path / "runs" / "agents" / "lorenz-y-0"
    assert Agent.read(folder / "agent.safetensors").information == "y"
    with pytest.raises(SystemExit, match="holds an agent already"):
        main(["agent", "train", "lorenz", "--information", "y", "--timesteps", "1"])
    main(["agent", "evaluate", str(folder / "agent.safetensors"), "--episodes", "3", "--out", "pictures"])
    assert "score" in capsys.readouterr().out
    with Image.open(tmp_path / "pictures" / "lorenz-y-0.5-0.gif") as animation:
        assert animation.n_frames > 20
    with Image.open(tmp_path / "pictures" / "lorenz-y-0.5-0.png") as figure:
        assert figure.size[0] > 200
    with pytest.raises(SystemExit, match="episodes from 1 to 10000; got 0 and 0"):
        main(["agent", "evaluate", str(folder / "agent.safetensors"), "--episodes", "0"])
    own = replace(Agent.read(folder / "agent.safetensors"), task=ControlTask("some.py:Evil"))
    own.save("own.safetensors")
    with pytest.raises(SystemExit, match=r"if you trust that, give --system some\.py:Evil"):
        main(["agent", "evaluate", "own.safetensors"])
    with pytest.raises(SystemExit, match="unknown system"):
        main(["agent", "train", "pendulum"])


@pytest.mark.parametrize("columns", [1, 2])
def test_figures_show_states_outputs_and_inputs(columns, learned, tmp_path, monkeypatch):
    """Each in a row; nothing of the legend is cut off."""
    drawn = []
    monkeypatch.setattr(figures, "save", lambda path, figure: drawn.append(figure))
    agent, _ = learned
    episodes = play(agent.make(columns), agent, steps=20, seed=0)
    picture.draw(TASK, episodes, tmp_path / "a.png")
    (figure,) = drawn
    axes = np.reshape(figure.axes, (4, columns))
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["x1", "x2", "y", "u"]
    for i in range(columns):
        found = [{line.get_label(): line.get_ydata() for line in ax.lines} for ax in axes[:, i]]
        for j in range(2):
            np.testing.assert_array_equal(found[j]["state"], episodes.x[:, i, j])
            np.testing.assert_array_equal(found[j]["estimate"], episodes.x_hat[:, i, j])
        np.testing.assert_array_equal(found[2]["measured output"], episodes.y[:, i, 0])
        np.testing.assert_array_equal(found[3]["input"], episodes.u[:, i, 0])
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert -10 < box.x0 < box.x1 < figure.bbox.x1 + 10


def test_metadata_is_json(learned):
    _, folder = learned
    with safe_open(folder / "agent.safetensors", framework="numpy") as opened:
        described = json.loads(opened.metadata()["kkl-gym-agent"])
    assert described["task"]["system"] == "van_der_pol"


@pytest.mark.parametrize(
    ("name", "least"), [("reverse_duffing", -0.25), ("van_der_pol", -0.2), ("rossler", -0.12), ("lorenz", -0.35)]
)
def test_shipped_agents_act_on_estimates(name, least):
    agent = Agent.read(find(name))
    assert (agent.information, agent.observer) == ("x_hat", name)
    assert agent.task == TASKS[name]
    system, episodes = get_system(name), play(agent.make(20), agent, steps=agent.task.steps, seed=0)
    assert scores(system, episodes.x).mean() > least  # zero input: about -0.6
    assert not episodes.escaped.any()
    noise = episodes.y - system.output(episodes.x)
    assert np.std(noise) == pytest.approx(agent.task.measurement_noise, rel=0.05)


def test_the_one_that_sees_y_differs_from_the_shipped_one_in_that_alone():
    blind, sighted = Agent.read(find("van_der_pol-y")), Agent.read(find("van_der_pol"))
    assert (blind.information, blind.observer) == ("y", None)
    assert (blind.task, blind.seed) == (sighted.task, sighted.seed)
    for setting in ("algorithm", "timesteps"):
        assert blind.training[setting] == sighted.training[setting]
    x = play(blind.make(20), blind, steps=blind.task.steps, seed=0).x
    assert scores(get_system("van_der_pol"), x).mean() < -0.5
