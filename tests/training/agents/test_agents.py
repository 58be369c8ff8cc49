"""Training, saving and playing agents, at toy size."""

import os
import re
import shutil
from dataclasses import replace

import linear_system
import numpy as np
import pytest
from linear_system import Oscillator
from PIL import Image
from stable_baselines3 import PPO, SAC

from examples.research.agents.recurrent import learn_recurrent
from kkl_gym import KKLVectorEnv, get_system
from observers import MLP, storage
from observers.names import resolve
from training import figures
from training.agents import picture
from training.agents.agent import Agent, AgentError, fingerprint, rules
from training.agents.cost import WORST, paid
from training.agents.information import observer_of
from training.agents.learn import hyperparameters, learn
from training.agents.play import play
from training.agents.seeds import AGENT_EVALUATION_SEED
from training.agents.tasks import TASKS, ControlTask, get_task, scores
from training.commands.agent import find

TASK = ControlTask("van_der_pol", measurement_noise=0.2, duration=0.5)
KEY = "kkl-gym-agent"
OBS = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)


@pytest.fixture(scope="module")
def learned(saved, tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    return learn(TASK, "x_hat", folder, observer=saved(), timesteps=1, seed=1), folder


@pytest.mark.parametrize(("algorithm", "kind"), [("ppo", PPO), ("sac", SAC)])
def test_the_policy_is_that_of_stable_baselines3(algorithm, kind, tmp_path, monkeypatch):
    models = []
    original = kind.learn

    def keep(self, timesteps, **options):
        models.append(self)
        return original(self, timesteps, **options)

    monkeypatch.setattr(kind, "learn", keep)
    agent = learn(TASK, "state", tmp_path, timesteps=1, algorithm=algorithm)
    expected, _ = models[0].predict(OBS, deterministic=True)
    assert np.allclose(agent(OBS), expected, atol=1e-5)
    assert np.abs(agent(100 * OBS)).max() <= 1.0


def test_seeds_make_agents_and_never_the_episodes_of_the_evaluation(learned, tmp_path, monkeypatch):
    """stable-baselines3 seeds environments when a model is made; each agent has seeds of its own all the same."""
    seeds = []
    reset = KKLVectorEnv.reset

    def noted(self, *, seed=None, options=None):
        seeds.append(seed)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(KKLVectorEnv, "reset", noted)
    agent, _ = learned
    again, other = (
        learn(TASK, "x_hat", tmp_path / str(seed), observer=agent.observer, timesteps=1, seed=seed) for seed in (1, 2)
    )
    assert np.array_equal(again(OBS), agent(OBS))
    assert not np.array_equal(other(OBS), agent(OBS))
    first, second = (set(given) for given in seeds if isinstance(given, list))
    assert not first & second
    assert not (first | second) & set(range(AGENT_EVALUATION_SEED, AGENT_EVALUATION_SEED + 10_000))


def test_a_saved_agent_plays_the_same(learned):
    agent, folder = learned
    read = Agent.read(folder / "agent.safetensors")
    assert (read.task, read.information, read.observer) == (TASK, "x_hat", agent.observer)
    assert read.fingerprint == fingerprint(agent.observer)
    assert (read.training["algorithm"], read.training["seed"], read.training["timesteps"]) == ("ppo", 1, 256 * 32)
    assert "rollout/ep_rew_mean" in (folder / "progress.csv").read_text().splitlines()[0]
    episodes = [play(one.make(4), one, steps=TASK.steps, seed=0) for one in (agent, read)]
    assert np.array_equal(episodes[0].x, episodes[1].x)
    assert episodes[0].x_hat.shape == episodes[0].x.shape == (TASK.steps + 1, 4, 2)


def test_starts_and_levels_of_noise_survive_saving(learned, tmp_path):
    agent, _ = learned
    two = get_task(f"{linear_system.__file__}:TwoOutputs", (0.2, 0.4))
    for task in (TASKS["van_der_pol"], two):
        whole = replace(agent, task=task, information="state", observer=None, rules=rules(task))
        whole.save(tmp_path / "a.safetensors")
        assert Agent.read(tmp_path / "a.safetensors").task == task
    assert get_task(two.system).measurement_noise == (0.1, 0.3)


def test_mismatches_are_errors(learned, saved, tmp_path):
    agent, _ = learned
    path = tmp_path / "map.safetensors"
    shutil.copy(saved(), path)
    own = replace(agent, observer=str(path), fingerprint=fingerprint(str(path)))
    assert own.make(1)
    shutil.copy(saved(noise=False), path)
    with pytest.raises(AgentError, match="trained on"):
        own.make(1)
    path.unlink()
    with pytest.raises(AgentError, match="observer cannot be read"):
        own.make(1)
    os.mkfifo(path)  # which is not waited for
    with pytest.raises(AgentError, match=r"cannot be read: .*map\.safetensors is a folder, a pipe or a device"):
        own.make(1)
    with pytest.raises(AgentError, match="must name its observer"):
        replace(agent, observer=None).make(1)
    with pytest.raises(AgentError, match="trained with target = "):
        replace(agent, rules={**agent.rules, "target": [1.0, 1.0]}).make(1)
    lorenz = replace(agent, task=TASKS["lorenz"], information="state", observer=None, rules=rules(TASKS["lorenz"]))
    with pytest.raises(AgentError, match="2 inputs and 1 outputs"):
        lorenz.make(1)


def test_damaged_and_foreign_files(saved, tmp_path):
    content = find("lorenz").read_bytes()
    for changed in (content[:-7], b"", content[:-1] + bytes([content[-1] ^ 1])):
        (tmp_path / "agent.safetensors").write_bytes(changed)
        with pytest.raises(AgentError, match=r"agent\.safetensors.* damaged"):
            Agent.read(tmp_path / "agent.safetensors")
    with pytest.raises(AgentError, match="is not an agent of kkl-gym"):
        Agent.read(saved())
    with pytest.raises(AgentError, match="there is no file"):
        Agent.read(tmp_path / "none.safetensors")
    with pytest.raises(AgentError, match="no agent 'nothing' ships"):
        find("nothing")


@pytest.mark.parametrize(("change", "says"), [
    (lambda t, d: t.update({"0.bias": np.full_like(t["0.bias"], np.nan)}), ""),
    (lambda t, d: t.pop("1.bias"), ""),
    (lambda t, d: d.update(format=9), "has format 9"),
    (lambda t, d: d.pop("activation"), "incomplete"),
    (lambda t, d: d.update(invented=1), ""),
    (lambda t, d: d.update(squashed=0), "squashed must be a bool"),
    (lambda t, d: d.update(information="x_hut"), "knows one of state, .* got 'x_hut'"),
    (lambda t, d: d.update(observer=3), "observer must be a string"),
    (lambda t, d: d.update(rules=[]), "rules must be a mapping"),
    (lambda t, d: d["training"].update(seed="x/../../out"), "seed must be a whole number"),
    (lambda t, d: d.update(task=[]), ""),
    (lambda t, d: d["task"].update(start_box=3), ""),
    (lambda t, d: d["task"].update(duration="0.05"), "duration must be a finite number"),
    (lambda t, d: d["task"].update(system=3), "system must be a name"),
])  # fmt: skip
def test_contents_that_make_no_agent(change, says, tmp_path):
    tensors, described = storage.read(find("lorenz"), key=KEY, error=AgentError, what="an agent")
    path = tmp_path / "agent.safetensors"
    change(tensors, described)
    storage.save(path, tensors, key=KEY, described=described)
    with pytest.raises(AgentError, match=f"{re.escape(str(path))}.*{says}"):
        Agent.read(path)


@pytest.fixture(scope="module")
def own():
    """An agent for a system that does not ship."""
    task = replace(TASK, system=f"{linear_system.__file__}:Oscillator")
    network = MLP([np.zeros((1, 2))], [np.zeros(1)], "tanh")
    return Agent(network=network, squashed=False, task=task, information="state", rules=rules(task))


def test_a_system_that_does_not_ship_is_imported_only_if_the_caller_names_it(own, tmp_path):
    evil = tmp_path / "evil.py"
    evil.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass Evil: pass\n")
    named = f"{evil}:Evil"
    stranger = replace(own, task=replace(own.task, system=named))
    for trusted in (None, own.task.system, "van_der_pol", "evil.py:Evil"):
        says = f"the agent's system is {named!r}, and system={trusted!r}: give"
        with pytest.raises(AgentError, match=re.escape(says)):
            stranger.make(1, system=trusted)
    assert stranger.make(1, system=Oscillator()).unwrapped.system == Oscillator()  # what the file names is not asked
    assert os.listdir(tmp_path) == ["evil.py"]


def test_a_system_may_be_given_by_name_as_a_class_or_itself(own, learned):
    for trusted in (own.task.system, Oscillator, Oscillator()):
        assert own.make(2, system=trusted).reset(seed=0)[0].shape == (2, 2)
    with pytest.raises(AgentError, match="trained with equations = "):
        own.make(1, system=get_system("van_der_pol"))
    with pytest.raises(ValueError, match="got 3"):
        own.make(1, system=3)
    agent, _ = learned
    for system in (None, "van_der_pol", get_system("van_der_pol")):
        assert agent.make(1, system=system)
    with pytest.raises(AgentError, match="the agent's system is 'van_der_pol', and system='lorenz'"):
        agent.make(1, system="lorenz")


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol-y"])
def test_shipped_files_are_written_again_as_they_are(name, tmp_path):
    Agent.read(find(name)).save(tmp_path / "new" / "agent.safetensors")
    assert (tmp_path / "new" / "agent.safetensors").read_bytes() == find(name).read_bytes()
    assert os.listdir(tmp_path / "new") == ["agent.safetensors"]


def test_pay_is_minus_the_cost_and_escaping_never_pays():
    """An action has five samples, whose rewards are 1 / (1 + 4 c); the second one of the third action escapes."""
    task, cost = ControlTask("rossler", period=0.05, duration=20.0), np.array([0.0, 0.3, 2 * WORST])
    total = task.repeat / (1 + 4 * cost)
    np.testing.assert_allclose(paid(task, total, 15, False), [0.0, -0.3, -WORST], atol=1e-12)
    escaped = paid(task, 0.4 * total, 12, True)
    np.testing.assert_allclose(escaped, np.array([0.0, -0.3, -WORST]) * (1 + task.steps - 3), atol=1e-9)


def test_hyperparameters(script):
    own = ControlTask(f"{script}:Pendulum")  # which gets the defaults
    duffing, lorenz = TASKS["reverse_duffing"], TASKS["lorenz"]
    assert [hyperparameters(task)[0] for task in (duffing, lorenz, own)] == ["sac", "ppo", "ppo"]
    assert hyperparameters(duffing, "ppo")[0] == "ppo"
    assert hyperparameters(own, "sac") == hyperparameters(lorenz, "sac") == hyperparameters(duffing)
    for algorithm in ("ppo", "sac", "ppo_lstm"):  # any of them for any system
        assert all(hyperparameters(task, algorithm)[1]["n_timesteps"] >= 100_000 for task in TASKS.values())
    with pytest.raises(ValueError, match="unknown algorithm 'dqn'"):
        hyperparameters(lorenz, "dqn")
    with pytest.raises(ValueError, match="algorithm must be one of ppo, sac"):
        learn(lorenz, "y", None, algorithm="ppo_lstm")
    with pytest.raises(ValueError, match="timesteps must be positive"):
        learn(lorenz, "y", None, timesteps=0)


def test_a_recurrent_policy_remembers_within_an_episode(tmp_path):
    policy = learn_recurrent(TASK, "y", tmp_path, timesteps=1)
    obs = np.ones((3, 2), np.float32)  # y and the action before
    one, two = policy(obs), policy(obs)
    assert one.shape == (3, 1)
    assert not np.allclose(one, two)


@pytest.mark.slow
def test_an_agent_learns(tmp_path):
    """Half a minute of PPO on the full state of Van der Pol."""
    task = TASKS["van_der_pol"]
    agent = learn(task, "state", tmp_path, timesteps=200_000)
    x = play(agent.make(50), agent, steps=task.steps, seed=0).x
    assert scores(get_system(task.system), x).mean() > -0.25


def test_pictures_show_states_outputs_and_inputs(learned, tmp_path, monkeypatch):
    """Each in a row; nothing of the legend is cut off."""
    drawn = []
    monkeypatch.setattr(figures, "save", lambda path, figure: drawn.append(figure))
    agent, _ = learned
    episodes = play(agent.make(1), agent, steps=TASK.steps, seed=0)
    picture.draw(TASK, episodes, tmp_path / "a.png")
    (figure,) = drawn
    assert [ax.get_ylabel() for ax in figure.axes] == ["x1", "x2", "y", "u"]
    found = [{line.get_label(): line.get_ydata() for line in ax.lines} for ax in figure.axes]
    for row, label, values in (
        (0, "state", episodes.x[:, 0, 0]),
        (1, "estimate", episodes.x_hat[:, 0, 1]),
        (2, "measured output", episodes.y[:, 0, 0]),
        (3, "input", episodes.u[:, 0, 0]),
    ):
        np.testing.assert_array_equal(found[row][label], values)
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert -10 < box.x0 < box.x1 < figure.bbox.x1 + 10
    picture.animate(TASK, {"": episodes}, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == TASK.steps


@pytest.mark.parametrize(
    ("name", "least"), [("reverse_duffing", -0.25), ("van_der_pol", -0.2), ("rossler", -0.12), ("lorenz", -0.35)]
)
def test_shipped_agents_act_on_estimates(name, least):
    agent, system = Agent.read(find(name)), get_system(name)
    assert (agent.information, agent.task) == ("x_hat", TASKS[name])
    assert resolve(agent.observer) == resolve(observer_of(system))
    episodes = play(agent.make(20), agent, steps=agent.task.steps, seed=0)
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
