"""The comparison of agents in any environments, at toy size."""

import shutil
from dataclasses import replace

import pandas as pd
import pytest
from examples.research.environments.command import COLUMNS, unusual
from examples.research.environments.comparison import KINDS, RANDOM, Case, planned
from examples.research.environments.tables import cell, write_table
from rich.console import Console
from small_agents import make_small

from examples.research.agents.command import Compare
from training.agents.any_environment.learning import hyperparameters, settings_of
from training.agents.any_environment.task import HIDDEN_VELOCITIES
from training.commands.environment import EnvironmentOptions
from training.commands.running import Workers

PENDULUM = HIDDEN_VELOCITIES["Pendulum-v1"]
CART = HIDDEN_VELOCITIES["CartPole-v1"]


@pytest.fixture
def compare(monkeypatch):
    make_small(monkeypatch)
    options = {"seeds": 1, "episodes": 2, "workers": Workers(1), "information": ("state", "y")}
    return lambda out, **changes: Compare(("CartPole-v1",), out=out, **{**options, **changes}).run(Console())


def test_a_comparison_resumes_and_says_what_is_missing(tmp_path, compare):
    compare(tmp_path, seeds=2)
    results = pd.read_csv(tmp_path / "results.csv")
    assert sorted(results.shown) == ["random", *["state"] * 2, *["y"] * 2]
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("jobs/**/result.json")}
    shutil.rmtree(tmp_path / "jobs" / "CartPole-v1" / "y" / "1")
    compare(tmp_path, seeds=2, information=("y",))  # a narrower run reports all that is there
    again = pd.read_csv(tmp_path / "results.csv")
    assert again.drop(columns="seconds").equals(results.drop(columns="seconds"))  # all is seeded
    changed = [path for path in before if path.stat().st_mtime_ns != before[path]]
    assert [path.parent.name for path in changed] == ["1"]
    table = (tmp_path / "table.md").read_text()
    assert "| CartPole-v1 |" in table
    assert "Partial" not in table
    assert all((tmp_path / name).stat().st_size > 100 for name in ("scores.png", "curves.png", "curves.csv"))
    with pytest.raises(ValueError, match="another comparison: episodes = 2 there, 5 here"):
        compare(tmp_path, seeds=2, episodes=5)


def test_what_changes_an_agent_is_part_of_its_identity(tmp_path):
    def differ(**changes):
        tasks = PENDULUM, replace(PENDULUM, **changes)
        cases = {kind: [Case(task, kind, 0, 2, None, 0, tmp_path) for task in tasks] for kind in (RANDOM, *KINDS)}
        return {kind for kind, (one, other) in cases.items() if one.identity != other.identity}

    assert differ(time_constants=(1, 2, 4), frames=9) == {"z", "stacked", "stacked_x_hat"}
    assert differ(angles=((0, 1),)) == differ(past_actions=False) == {"z", "stacked"}


def test_levels_of_noise_share_agents_on_the_full_state(tmp_path):
    tasks = [replace(PENDULUM, measurement_noise=level) for level in (0.1, 0.3)]
    names = [case.name for case in planned(tasks, tmp_path, kinds=("state", "y"), seeds=2)]
    assert [name for name in names if "state" in name] == ["Pendulum-v1/state/0", "Pendulum-v1/state/1"]
    assert len([name for name in names if "/y/" in name]) == 4
    assert len(names) == 7


def test_each_algorithm_learns_from_as_many_steps():
    for env_id in ("CartPole-v1", "Pendulum-v1", "MountainCarContinuous-v0", "LunarLander-v3", "HalfCheetah-v5"):
        algorithms = ("ppo_lstm", "sac" if env_id in settings_of("sac") else "ppo")
        assert len({hyperparameters(name, env_id)["n_timesteps"] for name in algorithms}) == 1


def test_a_table_of_known_results(tmp_path):
    rows = [("random", 0.0, 0, 10.0), *(("state", 0.0, i, 110.0 + i) for i in range(-2, 3))]
    rows += [("y", 0.2, i, 60.0 + 2 * i) for i in range(-2, 3)]
    results = pd.DataFrame([("A-v0", noise, *row, 7.0) for kind, noise, *rest in rows for row in [(kind, *rest)]])
    results.columns = ["environment", "noise", "shown", "seed", "return", "seconds"]
    found = cell(results, ("A-v0", 0.2), "y")
    assert found["middle"] == pytest.approx(60)
    assert found["interval"][0] == pytest.approx(0.5)
    assert 0.46 < found["interval"][1] < 0.5 < found["interval"][2] < 0.54
    assert cell(results, ("A-v0", 0.2), "state")["interval"][0] == pytest.approx(1.0)
    assert cell(results, ("A-v0", 0.2), "z") is None
    write_table(tmp_path / "table.md", results, " Partial: one.")
    table = (tmp_path / "table.md").read_text()
    assert "A-v0, noise 0.2 | 110 (1.00, " in table
    assert "| 60 (0.50, " in table
    assert "Partial: one." in table


def test_a_table_names_unusual_settings():
    options = EnvironmentOptions(angles=("0,1",), frames=2, no_past_actions=True)
    says = "Agents on z and on stacked observations: `frames` 2, `past_actions` False, `angles` ((0, 1),)."
    assert unusual([options.task("Pendulum-v1", noise) for noise in (0.0, 0.1)]) == says
    assert unusual([PENDULUM, CART]) == ""


def test_an_earlier_comparison_stands_beside_this_one(tmp_path, compare):
    kept = {
        "results.csv": ["Ball-v0,0.0,random,0,1.0,0.0", "Ball-v0,0.0,state,0,11.25,3.0", "Ball-v0,0.0,y,0,6.0,3.5"],
        "curves.csv": ["Ball-v0,0.0,state,10,1.5,2.0", "Ball-v0,0.0,y,10,1.5,0.125"],
    }
    for name, rows in kept.items():
        other = rows[-1].replace("Ball-v0", "CartPole-v1")
        lines = [",".join(COLUMNS[name]), other, other.replace(",y,", ",z,"), *rows]
        (tmp_path / name).write_text("\n".join(lines) + "\n")
    compare(tmp_path / "out", beside=tmp_path)
    for name, rows in kept.items():
        assert (tmp_path / "out" / name).read_text().splitlines()[-len(rows) :] == rows
    results = pd.read_csv(tmp_path / "out" / "results.csv")
    assert list(results.shown[:4]) == ["z", "random", "state", "y"]
    assert results["return"][0] == 6.0 != results["return"][3]
    assert "| Ball-v0 | 11.25 (1.00), 1 | – | 6 (0.49), 1 | 1 |" in (tmp_path / "out" / "table.md").read_text()
    for row, says in (
        ("Ball-v0,0.0,state,0,much,3.0", "column return holds something that is no number"),
        ("Ball-v0,0.0,state,0,,3.0", "row 3 lacks a value"),
        ("Ball-v0,0.0,everything,0,1.0,3.0", "shown everything; known are state, x_hat"),
        ("Ball-v0,0.0,random,0,1.0,0.0", "row 3 says again"),
    ):
        lines = [",".join(COLUMNS["results.csv"]), kept["results.csv"][0], row]
        (tmp_path / "results.csv").write_text("\n".join(lines))
        with pytest.raises(ValueError, match=rf"results.csv.*{says}"):
            compare(tmp_path / "bad", beside=tmp_path)
    assert not (tmp_path / "bad").exists()


def test_what_is_refused(tmp_path, compare):
    for options, says in (
        ({"information": ("ekf",)}, "compared by state"),
        ({"environments": ("CartPole-v1", "CartPole-v1")}, "environments, each once"),
        ({"environments": (), "environment": EnvironmentOptions(frames=2)}, "--frames: this is for agents in an"),
        ({"environments": (), "beside": tmp_path}, "--beside is for environments"),
    ):
        with pytest.raises(ValueError, match=says):
            Compare(**{"environments": ("CartPole-v1",), "out": tmp_path / "c", **options}).run(Console())
