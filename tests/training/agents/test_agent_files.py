"""Files of agents: agents play as trained, and invalid files and arguments are refused."""

import os
import re
import shutil
from dataclasses import replace

import linear_system
import numpy as np
import pytest

from kkl_gym import get_system
from observers import MLP, storage
from observers.names import resolve
from training.agents.agent import KEY, LSTM, Agent, AgentError, find, fingerprint, rules
from training.agents.information import observer_of
from training.agents.play import play
from training.agents.tasks import HIDDEN_VELOCITIES, TASKS, Task, get_task, scores

PENDULUM, CART = HIDDEN_VELOCITIES["Pendulum-v1"], HIDDEN_VELOCITIES["CartPole-v1"]
OWN = f"{linear_system.__file__}:Oscillator"


def agent(inputs=2, outputs=1, **changes):
    network = MLP([np.zeros((outputs, inputs))], [np.zeros(outputs)], "tanh")
    given = {"network": network, "head": "clip", "task": PENDULUM, "information": "y", **changes}
    return Agent(rules=rules(given["task"]), **given)


def played(one, n=20, **options):
    env = one.make(n, **options)
    return play(env, one.policy(env.single_action_space), seed=0)


@pytest.mark.parametrize(
    "changes",
    [
        {"task": replace(PENDULUM, time_constants=(1, 2), angles=((0, 1),)), "information": "z", "inputs": 6},
        {"task": TASKS["van_der_pol"], "information": "state"},
        {"task": get_task(f"{linear_system.__file__}:TwoOutputs", (0.2, 0.4)), "information": "y"},
        {"mean": np.ones(2), "scale": np.full(2, 0.5)},
        {"lstm": LSTM(np.ones((8, 5)), np.zeros(8)), "information": "recurrent"},
    ],
)
def test_a_file_holds_the_agent(changes, tmp_path):
    one = agent(**changes)
    one.save(tmp_path / "agent.safetensors")
    again = Agent.read(tmp_path / "agent.safetensors")
    assert (again.task, again.information, again.rules) == (one.task, one.information, one.rules)
    env = again.make(3, trusted=one.task.system or one.task.env_id)
    obs, _ = env.reset(seed=0)
    space = env.single_action_space
    np.testing.assert_array_equal(again.policy(space)(obs), one.policy(space)(obs))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"head": "softmax"}, "head"),
        ({"mean": np.zeros(2)}, "belong together"),
        ({"mean": np.zeros(2), "scale": np.array([1.0, np.nan])}, "2 finite numbers"),
        ({"lstm": LSTM(np.ones((8, 5)), np.zeros(12))}, "does not fit its bias"),
        ({"training": {"seed": "x/../../out"}}, "seed must be a whole number"),
    ],
)
def test_invalid_agents_are_refused(changes, message):
    with pytest.raises(AgentError, match=message):
        agent(**changes)


def test_mismatches_are_errors(saved, tmp_path):
    path = tmp_path / "map.safetensors"
    shutil.copy(saved(), path)
    task = TASKS["van_der_pol"]
    on_map = agent(task=task, information="x_hat", observer=str(path), fingerprint=fingerprint(str(path)))
    assert on_map.make(1)
    shutil.move(path, tmp_path / "moved.safetensors")
    with pytest.raises(AgentError, match="observer cannot be read"):
        on_map.make(1)
    assert on_map.make(1, observer=str(tmp_path / "moved.safetensors"))
    shutil.copy(saved(noise=False), path)
    with pytest.raises(AgentError, match="not trained with the observer"):
        on_map.make(1)
    with pytest.raises(AgentError, match="trained with target = "):
        replace(agent(task=task, information="state"), rules={**rules(task), "target": [1.0, 1.0]}).make(1)
    for wrong, message in (
        ({"task": TASKS["lorenz"], "information": "state"}, "1 outputs, but the environment needs 3 and 1"),
        ({"head": "argmax"}, "head is argmax"),
    ):
        with pytest.raises(AgentError, match=message):
            agent(**wrong).make()


def test_damaged_and_foreign_files(saved, tmp_path):
    content, path = find("lorenz").read_bytes(), tmp_path / "agent.safetensors"
    for changed in (content[:-7], b"", content[:-1] + bytes([content[-1] ^ 1])):
        path.write_bytes(changed)
        with pytest.raises(AgentError, match=r"agent\.safetensors.* damaged"):
            Agent.read(path)
    with pytest.raises(AgentError, match="is not an agent of kkl-gym"):
        Agent.read(saved())
    with pytest.raises(AgentError, match="there is no file"):
        Agent.read(tmp_path / "none.safetensors")
    with pytest.raises(AgentError, match="no agent 'nothing' ships"):
        find("nothing")


@pytest.mark.parametrize(("change", "message"), [
    (lambda t, d: t.update({"0.bias": np.full_like(t["0.bias"], np.nan)}), ""),
    (lambda t, d: d.update(format=9), "has format 9"),
    (lambda t, d: d.pop("activation"), "incomplete"),
    (lambda t, d: d.update(invented=1), "unknown metadata keys: invented"),
    (lambda t, d: d["task"].update(env_id=3), "env_id must be a string"),
])  # fmt: skip
def test_contents_that_make_no_agent(change, message, tmp_path):
    tensors, described = storage.read(find("lorenz"), key=KEY, error=AgentError, what="an agent")
    path = tmp_path / "agent.safetensors"
    change(tensors, described)
    storage.save(path, tensors, key=KEY, described=described)
    with pytest.raises(AgentError, match=f"{re.escape(str(path))}.*{message}"):
        Agent.read(path)


@pytest.mark.parametrize("kind", ["script", "module"])
def test_scripts_named_in_an_agents_file_are_imported_only_if_the_caller_trusts_them(kind, tmp_path):
    evil = tmp_path / "evil.py"
    evil.write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\nclass Evil: pass\n")
    named = f"{evil}:Evil" if kind == "script" else "no_such_module:Evil-v0"
    own = replace(agent(task=get_task(OWN), information="state"))
    task = replace(own.task, env_kwargs={**own.task.env_kwargs, "system": named})
    stranger = replace(own, task=task if kind == "script" else Task(named, (0, 1)))
    stranger.save(tmp_path / "agent.safetensors")
    found = Agent.read(tmp_path / "agent.safetensors")
    for trusted in (None, OWN, "van_der_pol", "evil.py:Evil"):
        with pytest.raises(AgentError, match=re.escape(f"environment is {named!r}, but trusted is {trusted!r}")):
            found.make(1, trusted=trusted)
    assert sorted(os.listdir(tmp_path)) == ["agent.safetensors", "evil.py"]
    with pytest.raises(ValueError, match=r"no_such_module|evil"):
        found.make(1, trusted=named)
    assert own.make(2, trusted=OWN).reset(seed=0)[0].shape == (2, 2)


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol-y"])
def test_shipped_agents_are_read_and_written_without_a_change(name, tmp_path):
    Agent.read(find(name)).save(tmp_path / "new" / "agent.safetensors")
    assert (tmp_path / "new" / "agent.safetensors").read_bytes() == find(name).read_bytes()
    assert os.listdir(tmp_path / "new") == ["agent.safetensors"]


@pytest.mark.parametrize(
    ("name", "least"), [("reverse_duffing", -0.25), ("van_der_pol", -0.2), ("rossler", -0.12), ("lorenz", -0.35)]
)
def test_shipped_agents_act_on_estimates(name, least):
    one, system = Agent.read(find(name)), get_system(name)
    assert (one.information, one.task) == ("x_hat", TASKS[name])
    assert resolve(one.observer) == resolve(observer_of(system))
    episodes = played(one)
    assert scores(system, episodes.x).mean() > least  # zero input scores about -0.6
    assert not episodes.escaped.any()
    assert (episodes.lengths == one.task.steps).all()
    assert (episodes.returns > 0).all()
    assert (episodes.returns < one.task.steps * one.task.repeat).all()
    noise = episodes.y - system.output(episodes.x)
    assert np.std(noise) == pytest.approx(one.task.measurement_noise, rel=0.05)


def test_rows_that_end_early_are_not_played_further():
    """With a constant action, the poles of the rows fall at different times."""
    env = agent(task=CART, outputs=2, head="argmax").make(5)
    episodes = play(env, lambda obs: np.zeros(5, dtype=int), seed=0)
    np.testing.assert_array_equal(episodes.returns, episodes.lengths)
    assert 7 < episodes.lengths.min() < episodes.lengths.max() < 12
    assert episodes.escaped.all()
    with pytest.raises(ValueError, match="hold no x"):
        episodes.signals("x")
