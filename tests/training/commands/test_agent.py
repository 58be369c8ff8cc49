"""``kkl-gym agent``: episodes, intervals, and systems of one's own; tests/training/agents has the rest."""

from functools import partial

import linear_system
import numpy as np
import pytest

import training.agents.learn
import training.agents.picture
from kkl_gym.compiled import SamplingStep
from kkl_gym.simulate import advance_batch
from training.agents.agent import Agent
from training.agents.seeds import AGENT_EVALUATION_SEED, agent_evaluation_seed
from training.cli import main
from training.commands.agent import Evaluate, interval

OWN = f"{linear_system.__file__}:Oscillator"


@pytest.fixture(autouse=True)
def _nothing_is_compiled(monkeypatch):
    monkeypatch.setattr("kkl_gym.vector.batch_step", lambda system: SamplingStep(partial(advance_batch, system)))


def test_seeds_of_the_evaluation_share_no_episode():
    assert agent_evaluation_seed(0, 100) == AGENT_EVALUATION_SEED  # on which published results rest
    assert agent_evaluation_seed(1, 10_000) >= agent_evaluation_seed(0, 10_000) + 10_000
    for seed, episodes in ((-1, 1), (0, 0), (0, 10_001)):
        with pytest.raises(ValueError, match=f"got {seed} and {episodes}"):
            agent_evaluation_seed(seed, episodes)


def test_intervals_over_episodes():
    values = np.random.default_rng(0).normal(size=500)
    error = 1.96 * values.std() / np.sqrt(500)
    assert interval(values) == pytest.approx((values.mean(), values.mean() - error, values.mean() + error), abs=0.01)
    assert interval(np.ones(10)) == (1.0, 1.0, 1.0)  # all hold the target
    assert np.isnan(interval(np.ones(1))[1:]).all()


def test_an_agent_is_played_on_the_episodes_of_a_seed(capsys, monkeypatch):
    for name in ("draw", "animate"):  # which take most of the time
        monkeypatch.setattr(training.agents.picture, name, lambda task, episodes, path: None)
    assert Evaluate("lorenz").episodes == 500
    shown = []
    for seed in ("0", "0", "1"):
        main(["agent", "evaluate", "lorenz", "--episodes", "2", "--seed", seed])
        lines = capsys.readouterr().out.splitlines()
        shown.append("\n".join(line for line in lines if " passed" not in line))  # progress, on a slow machine
    assert "[" in shown[0]
    assert shown[0] == shown[1] != shown[2]


def test_an_agent_for_a_system_of_ones_own(tmp_path, saved, script, monkeypatch):
    small = {"n_envs": 2, "n_epochs": 1, "batch_size": 32}
    of = training.agents.learn.hyperparameters
    monkeypatch.setattr("training.agents.learn.hyperparameters", lambda *task: (of(*task)[0], of(*task)[1] | small))
    monkeypatch.setattr("training.agents.picture.animate", lambda task, episodes, path: None)
    observer = saved(system=OWN)
    main(["agent", "train", OWN, "--observer", observer, "--timesteps", "1"])
    path = "runs/agents/oscillator-x_hat-0/agent.safetensors"
    agent = Agent.read(path)
    assert (agent.observer, agent.training["algorithm"]) == (observer, "ppo")
    with pytest.raises(SystemExit, match="if you trust that, give --system"):
        main(["agent", "evaluate", path, "--episodes", "2"])
    main(["agent", "evaluate", path, "--episodes", "2", "--system", OWN])
    assert (tmp_path / "runs" / "agents" / "oscillator-x_hat-0.1-0.png").exists()
    with pytest.raises(SystemExit, match="Pendulum has no inputs"):
        main(["agent", "train", f"{script}:Pendulum", "--information", "y"])
