"""Comparisons of agents, on systems and in environments, at toy size."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import research
from matplotlib.figure import Figure
from PIL import Image

from examples.research.agents import picture
from examples.research.agents.comparison import read_results
from examples.research.agents.filtered import kalman_filters, show_filtered
from examples.research.agents.statistics import interval, middle, normalised
from examples.research.agents.tables import write_table
from training.agents.agent import Agent, find
from training.agents.observing import SETTINGS
from training.agents.play import play
from training.agents.tasks import HIDDEN_VELOCITIES, control_task

PENDULUM = HIDDEN_VELOCITIES["Pendulum-v1"]
PUBLISHED = Path(__file__).parents[2] / "docs" / "results"


def test_agents_on_a_system_are_compared_and_not_trained_again(tmp_path):
    common = ("agents", "lorenz", "--seeds", "1", "--timesteps", "1", "--measurement-noise", "0.5", "--jobs", "1")
    common += ("--out", str(tmp_path))
    research(*common, "--episodes", "2", "--information", "state", "ekf")
    results = pd.read_csv(tmp_path / "results.csv")
    assert results[["environment", "noise", "shown", "seed"]].to_numpy().tolist() == [
        ["lorenz", 0.5, kind, 0] for kind in ("random", "state", "ekf")
    ]
    assert (results["return"] < 0).all()
    assert (tmp_path / "scores.png").stat().st_size > 1000
    files = {path: path.stat().st_mtime_ns for path in tmp_path.glob("jobs/*/state/0/*")}
    shutil.rmtree(tmp_path / "jobs" / "lorenz-0.5" / "ekf")
    research(*common, "--episodes", "2", "--information", "ekf")
    again = pd.read_csv(tmp_path / "results.csv")
    assert again.drop(columns="seconds").equals(results.drop(columns="seconds"))  # all randomness is seeded
    assert {path: path.stat().st_mtime_ns for path in files} == files
    with pytest.raises(SystemExit, match="of another comparison: episodes = 2 there, 3 here"):
        research(*common, "--episodes", "3", "--information", "ekf")


def test_agents_in_an_environment_are_compared(tmp_path, monkeypatch):
    monkeypatch.setitem(SETTINGS, "inverse_steps", 20)
    kinds = ["state", "x_hat", "stacked"]
    common = ("agents", "CartPole-v1", "--seeds", "1", "--episodes", "2", "--timesteps", "600", "--frames", "4")
    research(*common, "--jobs", "1", "--out", str(tmp_path), "--information", *kinds)
    results, curves = (pd.read_csv(tmp_path / name) for name in ("results.csv", "curves.csv"))
    assert list(results.shown) == ["random", *kinds]
    assert set(curves.shown) == set(kinds)
    assert "Agents on z, traces and stacked observations: `frames` 4." in (tmp_path / "table.md").read_text()
    for name in ("scores.png", "curves.png"):
        assert (tmp_path / name).stat().st_size > 1000


def test_impossible_comparisons(tmp_path):
    for wrong, message in (
        ("--seeds 0", "must be positive"),
        ("lorenz CartPole-v1", "on systems or in environments"),
        ("CartPole-v1 --information ekf", "cannot act on ekf"),
        ("lorenz --observers rossler", "the observer rossler is for rossler"),
        ("lorenz --observers lorenz-spinn", "has no inputs"),
    ):
        with pytest.raises(SystemExit, match=message):
            research("agents", *wrong.split(), "--out", str(tmp_path))
    assert not (tmp_path / "jobs").exists()


@pytest.mark.parametrize("name", ["agents", "environments"])
def test_the_published_tables_follow_from_the_published_results(name, tmp_path):
    write_table(tmp_path / "table.md", read_results(PUBLISHED / name))
    assert (tmp_path / "table.md").read_text() == (PUBLISHED / name / "table.md").read_text()


def test_statistics_by_hand():
    assert normalised(np.array([-0.1, -0.3, -0.4]), -0.2, -0.6).tolist() == pytest.approx([1.25, 0.75, 0.5])
    assert np.isnan(normalised(np.array([-0.1]), -0.6, -0.6)).all()  # the best agent is no better than zero input
    assert middle(np.array([0.0, 1.0, 2.0, 3.0, 100.0])) == 2.0
    best, values = np.zeros(4), np.array([-0.2, -0.3, -0.4, -0.5])
    score, low, high = interval(values, best, -1.0)
    assert score == pytest.approx(0.65)
    assert 0.5 <= low < score < high <= 0.8
    varied = np.array([-0.2, -0.1, 0.1, 0.2])
    assert interval(varied, varied, -1.0)[0] == 1.0
    wider = interval(values, varied, -1.0)
    assert wider[2] - wider[1] > high - low  # the scores of the best agents are uncertain too
    assert np.isnan(interval(values[:2], best, -1.0)[1:]).all()


def test_kalman_filters_that_get_the_input_follow_a_driven_state():
    env = show_filtered(control_task("van_der_pol", 0.1, period=0.01, duration=5.0), "x_hat", 3)
    env.reset(seed=0)
    errors = []
    for action in np.random.default_rng(0).uniform(-1.5, 1.5, (400, 3, 1)):
        *_, info = env.step(action)
        errors.append(np.abs(info["x_hat"] - info["x"]).max())
    assert max(errors[200:]) < 0.1 < errors[0]
    y, unknown = np.ones((3, 1)), np.full((3, 2), np.nan)  # NaN states: the filters must not use them
    filters, rows = kalman_filters(env.unwrapped), np.array([True, False, False])
    filters.reset(y, unknown)
    first = filters.report()["x_hat"]
    filters.advance(-y, np.zeros((3, 1)))
    assert (filters.report()["x_hat"] != first).any(1).all()
    filters.restart(y[:1], rows, unknown[:1])
    assert ((filters.report()["x_hat"] == first).all(1) == rows).all()


def test_pictures_show_states_outputs_and_inputs(tmp_path, monkeypatch):
    drawn, savefig = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: drawn.append(figure) or savefig(figure, path))
    agent = Agent.read(find("van_der_pol"))
    task = replace(agent.task, env_kwargs={**agent.task.env_kwargs, "max_episode_steps": 50})
    env = replace(agent, task=task).make()
    episodes = play(env, agent.policy(env.single_action_space), seed=0)
    picture.draw(task, {"one": episodes}, tmp_path / "a.png")
    (figure,) = drawn
    assert [ax.get_ylabel() for ax in figure.axes] == ["x1", "x2", "y", "u"]
    picture.animate(task, {"": episodes}, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == task.steps
