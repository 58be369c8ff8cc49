"""Comparisons of agents, on systems and in environments, at toy size."""

import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
from commands import research

from examples.research.agents import environment_agents, system_agents
from examples.research.agents.statistics import interval, middle, normalised
from examples.research.agents.tables import report_systems, write_environments
from examples.research.agents.window import Stacks, WindowEstimator, learn_window, show_window
from training.agents.any_environment.information import Stacked, part_of
from training.agents.any_environment.learning import hyperparameters, settings_of
from training.agents.any_environment.observing import SETTINGS, wander
from training.agents.any_environment.task import HIDDEN_VELOCITIES
from training.progress import progress_bars
from training.rollouts.playing import Recorder

PENDULUM, CART = HIDDEN_VELOCITIES["Pendulum-v1"], HIDDEN_VELOCITIES["CartPole-v1"]
PUBLISHED = Path(__file__).parents[2] / "docs" / "results"


def test_agents_on_a_system_are_compared_and_not_trained_again(tmp_path):
    common = ("agents", "--systems", "lorenz", "--seeds", "1", "--timesteps", "1", "--no-more-noise", "--jobs", "1")
    common += ("--out", str(tmp_path))
    research(*common, "--episodes", "2", "--information", "state", "y")
    results = pd.read_csv(tmp_path / "results.csv")
    assert results[["system", "noise", "knows", "seed"]].to_numpy().tolist() == [
        ["lorenz", 0.5, "state", 0],
        ["lorenz", 0.5, "y", 0],
    ]
    assert ((results.score <= 0) & (results.idle < 0)).all()
    assert "Partial: 206 of 208 agents are missing" in (tmp_path / "table.md").read_text()
    assert (tmp_path / "scores.png").stat().st_size > 1000
    files = {path: path.stat().st_mtime_ns for path in tmp_path.glob("jobs/*/state/0/*")}
    shutil.rmtree(tmp_path / "jobs" / "lorenz-0.5" / "y")
    research(*common, "--episodes", "2", "--information", "y")
    again = pd.read_csv(tmp_path / "results.csv")
    assert again.drop(columns="seconds").equals(results.drop(columns="seconds"))  # all is seeded
    assert {path: path.stat().st_mtime_ns for path in files} == files
    with pytest.raises(SystemExit, match="of another comparison: episodes = 2 there, 3 here"):
        research(*common, "--episodes", "3", "--information", "y")


def test_agents_in_an_environment_are_compared_beside_earlier_ones(tmp_path, monkeypatch):
    monkeypatch.setitem(SETTINGS, "inverse_steps", 20)
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    kept = {
        "results.csv": ["Ball-v0,0.0,random,0,1.0,0.0", "Ball-v0,0.0,state,0,11.25,3.0", "Ball-v0,0.0,y,0,6.0,3.5"],
        "curves.csv": ["Ball-v0,0.0,state,10,1.5,2.0", "Ball-v0,0.0,y,10,1.5,0.125"],
    }
    for name, rows in kept.items():
        replaced = rows[-1].replace("Ball", "CartPole").replace("v0", "v1")
        (earlier / name).write_text("\n".join([",".join(environment_agents.COLUMNS[name]), replaced, *rows]) + "\n")
    common = ("agents", "CartPole-v1", "--seeds", "1", "--episodes", "2", "--timesteps", "600", "--aggregate", "1")
    common += ("--jobs", "1", "--frames", "4", "--out", str(tmp_path / "out"), "--beside", str(earlier))
    kinds = ["state", "x_hat", "stacked_x_hat", "y"]
    research(*common, "--information", *kinds)
    results, curves = (pd.read_csv(tmp_path / "out" / name) for name in kept)
    assert list(results.shown) == ["random", "state", "y", "random", *kinds]
    assert list(results.environment) == ["Ball-v0"] * 3 + ["CartPole-v1"] * 5
    assert set(curves[curves.environment == "CartPole-v1"].shown) == set(kinds)
    for name, rows in kept.items():
        assert (tmp_path / "out" / name).read_text().splitlines()[1 : 1 + len(rows)] == rows
    table = (tmp_path / "out" / "table.md").read_text()
    assert "| Ball-v0 | 11.25 (1.00), 1 | – | – | 6 (0.49), 1 | 1 |" in table
    assert "Agents on z and on stacked observations: `frames` 4." in table
    for name in ("scores.png", "curves.png"):
        assert (tmp_path / "out" / name).stat().st_size > 1000
    (earlier / "results.csv").write_text("environment,steps\n")
    with pytest.raises(SystemExit, match=r"results.csv.*its columns are environment, steps, not environment, noise"):
        research(*common)


def test_impossible_comparisons(tmp_path):
    for wrong, message in (
        ("--seeds 0", "must be positive"),
        ("--systems lorenz lorenz", "give some systems, each once"),
        ("--information stacked_x_hat", "compared by state"),
        ("CartPole-v1 --information ekf", "compared by state"),
        ("--beside runs", "--beside is for environments"),
        ("--frames 2", "--frames: this is for agents in an environment"),
        ("--systems lorenz --observers rossler", "the observer rossler is for rossler"),
        ("--systems lorenz --observers lorenz-spinn", "takes in no inputs"),
        ("--systems mine.py:Mine", "no file mine.py"),
    ):
        with pytest.raises(SystemExit, match=message):
            research("agents", *wrong.split(), "--out", str(tmp_path))
    assert not (tmp_path / "jobs").exists()


def test_planned_agents():
    agents = system_agents.planned(Path())
    assert len({agent.folder for agent in agents}) == len(agents) == 6 * 6 * 5 + 4 * 2 * 3 + 2 * 2
    assert {agent.information for agent in agents} == set(system_agents.USUAL_KINDS)
    tasks = [replace(PENDULUM, measurement_noise=level) for level in (0.1, 0.3)]
    names = [agent.name for agent in environment_agents.planned(tasks, Path(), kinds=("state", "y"), seeds=2)]
    assert len(names) == 7  # levels of noise share the agents on the state
    assert [name for name in names if "state" in name] == ["Pendulum-v1/state/0", "Pendulum-v1/state/1"]
    for env_id in ("CartPole-v1", "Pendulum-v1", "LunarLander-v3", "HalfCheetah-v5"):  # all learn from as many steps
        algorithms = ("ppo_lstm", "sac" if env_id in settings_of("sac") else "ppo")
        assert len({hyperparameters(name, env_id)["n_timesteps"] for name in algorithms}) == 1


def test_settings_of_memories_and_stacks_concern_those_agents_alone():
    def differ(changed):
        how = {"seed": 0, "episodes": 2, "timesteps": None, "aggregate": 0, "folder": Path()}
        agents = {kind: [environment_agents.EnvironmentAgent(task, kind, **how) for task in (PENDULUM, changed)]
                  for kind in ("random", *environment_agents.KINDS)}  # fmt: skip
        return {kind for kind, (one, other) in agents.items() if one.identity != other.identity}

    assert differ(replace(PENDULUM, time_constants=(1, 2, 4), frames=9)) == {"z", "stacked", "stacked_x_hat"}
    assert differ(replace(PENDULUM, angles=((0, 1),), past_actions=False)) == {"z", "stacked"}


def test_the_published_tables_follow_from_the_published_results(tmp_path):
    shutil.copy(PUBLISHED / "agents" / "results.csv", tmp_path)
    report_systems(tmp_path)
    assert (tmp_path / "table.md").read_text() == (PUBLISHED / "agents" / "table.md").read_text()
    write_environments(tmp_path / "table.md", pd.read_csv(PUBLISHED / "environments" / "results.csv"))
    assert (tmp_path / "table.md").read_text() == (PUBLISHED / "environments" / "table.md").read_text()


def test_statistics_by_hand():
    assert normalised(np.array([-0.1, -0.3, -0.4]), -0.2, -0.6).tolist() == pytest.approx([1.25, 0.75, 0.5])
    assert np.isnan(normalised(np.array([-0.1]), -0.6, -0.6)).all()  # the best is no better than idle
    assert middle(np.array([0.0, 1.0, 2.0, 3.0, 100.0])) == 2.0
    best, values = np.zeros(4), np.array([-0.2, -0.3, -0.4, -0.5])
    score, low, high = interval(values, best, -1.0)
    assert score == pytest.approx(0.65)
    assert 0.5 <= low < score < high <= 0.8
    varied = np.array([-0.2, -0.1, 0.1, 0.2])
    assert interval(varied, varied, -1.0)[0] == 1.0
    wider = interval(values, varied, -1.0)
    assert wider[2] - wider[1] > high - low  # the best are uncertain, too
    assert np.isnan(interval(values[:2], best, -1.0)[1:]).all()


@pytest.mark.parametrize("task", [PENDULUM, CART], ids=["pendulum", "cart"])
def test_the_rival_is_fitted_to_the_stacks_that_it_will_see(task):
    whole = task.make()
    recorder = Recorder(whole, **task.signals(whole.observation_space.shape[0]))
    env = gym.wrappers.Autoreset(Stacked(part_of(recorder, task.measured), 5))
    env.action_space.seed(0)
    seen = [env.reset(seed=0)[0], *(env.step(env.action_space.sample())[0] for _ in range(450))]
    records = recorder.rollouts().records()
    states = np.concatenate([record.x for record in records])
    stacks = Stacks(replace(task, frames=5), records)
    batch = stacks(torch.Generator().manual_seed(0))
    inputs = batch.inputs.numpy() * stacks.scale + stacks.mean
    apart = np.abs(inputs[:, None] - np.array(seen)).max(-1)
    here = apart.argmin(1)
    np.testing.assert_allclose(apart.min(1), 0.0, atol=1e-5)
    np.testing.assert_allclose(batch.x.numpy() * stacks.x_scale + stacks.x_mean, states[here], atol=1e-5)
    ages = np.concatenate([np.arange(len(record.t)) for record in records])
    np.testing.assert_array_equal(batch.cell, np.minimum(ages[here], 4))


@pytest.mark.research
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_the_rival_estimates_hidden_signals(noise, tmp_path):
    task = replace(PENDULUM, measurement_noise=noise)
    with progress_bars(None) as bars:
        path = learn_window(task, wander(task, 5000, seed=0, progress=bars), tmp_path, seed=0, progress=bars)
    env, plain = show_window(task, path), PENDULUM.make()
    seen, exact = [env.reset(seed=7)[0]], [plain.reset(seed=7)[0]]
    for _ in range(150):
        action = env.action_space.sample()
        seen.append(env.step(action)[0])
        exact.append(plain.step(action)[0])
    apart = np.std(np.subtract(seen, exact)[8:], 0) / np.std(exact, 0)
    assert (apart[:2] < (0.25 if noise else 1e-6)).all()
    assert apart[2] < (0.5 if noise else 0.1)
    assert WindowEstimator.read(path).network.inputs == 8 * 3
