"""The comparison of agents, at toy size."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import examples.research.agents.comparison
import training.agents.learn
from examples.research.agents.command import Compare, report
from examples.research.agents.comparison import (
    COMPARED,
    MORE_NOISE,
    OTHER,
    collect,
    planned,
    run_case,
)
from examples.research.agents.statistics import interval, middle, normalised
from training.commands.running import Workers
from training.jobs import claimed_job, locked
from training.parallel import Engine
from training.systems import PROFILES


def toy(out, **options):
    settings = {
        "systems": ("lorenz",),
        "seeds": 2,
        "episodes": 3,
        "timesteps": 1,
        "more_noise": False,
        "workers": Workers(1),
    }
    return Compare(out=out, **{**settings, **options})


def toy_cases(out, *information):
    return planned(
        out, systems=("lorenz",), information=information, seeds=1, episodes=3, timesteps=1, more_noise=False
    )


def test_a_comparison_resumes_and_says_what_is_missing(tmp_path, capsys):
    out = tmp_path / "a"
    toy(out, information=("state", "y")).run(Console())
    results = pd.read_csv(out / "results.csv")
    assert len(results) == 4
    assert (results.score <= 0).all()
    assert np.isfinite(results.to_numpy()[:, 4:].astype(float)).all()
    table = (out / "table.md").read_text()
    assert "Partial: 204 of 208 agents are missing" in table
    assert (out / "scores.png").stat().st_size > 1000
    before = {path: path.stat().st_mtime_ns for path in out.glob("jobs/**/scores.json")}
    shutil.rmtree(out / "jobs" / "lorenz-0.5" / "y" / "1")
    toy(out, information=("y",)).run(Console())  # a narrower run reports all that is there
    again = pd.read_csv(out / "results.csv")
    assert again.drop(columns="seconds").equals(results.drop(columns="seconds"))  # all is seeded
    changed = [path for path in before if path.stat().st_mtime_ns != before[path]]
    assert [path.parts[-3:-1] for path in changed] == [("y", "1")]
    with pytest.raises(ValueError, match="of another comparison: episodes = 3 there, 4 here"):
        toy(out, information=("y",), episodes=4).run(Console())


def missing(table):
    """How many agents a table says to be missing."""
    return int(re.search(r"Partial: (\d+) of", table)[1])


def test_table_and_figure_from_the_results_alone(tmp_path):
    rows = [
        {"system": "lorenz", "noise": 0.5, "knows": knows, "seed": seed, "score": score + 0.01 * seed, "success": 0.5,
         "idle": -0.6, "seconds": 60.0}
        for knows, score, seeds in (("state", -0.2, 4), ("y", -0.4, 4), ("recurrent", -0.3, 1))
        for seed in range(seeds)
    ]  # fmt: skip
    pd.DataFrame(rows).to_csv(tmp_path / "results.csv", index=False)
    report(tmp_path)
    table = (tmp_path / "table.md").read_text()
    assert "| full state | 1.00 [0." in table
    assert "| y | 0.52 [0." in table
    assert ", 50 %, 4 |" in table
    assert "| y, recurrent agent | 0.72, 50 %, 1 |" in table  # too few for an interval
    assert "full state 1.0" in table.splitlines()[-1]
    assert (tmp_path / "scores.png").stat().st_size > 1000
    assert "standard deviations" not in table  # which nobody asked for
    unsure = pd.DataFrame(rows[:4]).assign(knows="x_hat_std", score=-0.3)
    pd.concat([pd.DataFrame(rows), unsure]).to_csv(tmp_path / "results.csv", index=False)
    report(tmp_path)
    assert "| x̂ and its standard deviations | 0.72 [0." in (tmp_path / "table.md").read_text()
    assert missing((tmp_path / "table.md").read_text()) == missing(table) + 1  # the fifth seed
    only_y = pd.DataFrame(rows).query("knows != 'state'")
    only_y.to_csv(tmp_path / "results.csv", index=False)
    report(tmp_path)
    assert "| y | – |" in (tmp_path / "table.md").read_text()  # nothing to measure it by


def test_results_of_another_task_or_other_hyperparameters_are_not_mixed(tmp_path, monkeypatch):
    (case,) = toy_cases(tmp_path, "y")
    run_case(case)
    assert case.done
    with monkeypatch.context() as patch:
        other = replace(PROFILES["lorenz"], task=replace(PROFILES["lorenz"].task, tolerance=0.3))
        patch.setitem(PROFILES, "lorenz", other)
        with pytest.raises(ValueError, match="of another comparison: task"):
            assert not case.done
    with monkeypatch.context() as patch:
        read = training.agents.learn._read
        patch.setattr(training.agents.learn, "_read", lambda name: {**read(name), "KKLLorenz-v0": {"gamma": 0.5}})
        with pytest.raises(ValueError, match="of another comparison: hyperparameters"):
            assert not case.done
    assert case.done


def test_maps_without_error_bars_are_refused_before_anything_is_trained(tmp_path):
    command = Compare(
        systems=("lorenz",), information=("x_hat", "x_hat_std"), observers=("lorenz-spinn",), out=tmp_path
    )
    with pytest.raises(ValueError, match="holds no error bars"):
        command.run(Console())
    assert not (tmp_path / "jobs").exists()


@pytest.mark.parametrize("text", ["", "[]", '{"scores": [0.0]}', '{"scores": [0.0], "successes": [1], "seconds": '])
def test_scores_that_are_damaged_are_named(text, tmp_path):
    (case,) = toy_cases(tmp_path, "y")
    with claimed_job(case.folder, case.identity, OTHER):
        (case.folder / "scores.json").write_text(text)
    with pytest.raises(ValueError, match=re.escape(str(case.folder / "scores.json"))):
        collect(tmp_path, episodes=case.episodes, timesteps=case.timesteps)


def test_an_interrupted_comparison_still_reports(tmp_path, monkeypatch):
    def interrupted(engine, run, jobs):
        run(jobs[0])
        yield jobs[0], None
        raise KeyboardInterrupt

    monkeypatch.setattr(Engine, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        toy(tmp_path, information=("state", "y")).run(Console())
    assert len(pd.read_csv(tmp_path / "results.csv")) == 1
    assert "Partial: 207 of 208 agents are missing" in (tmp_path / "table.md").read_text()


def test_a_recurrent_agent_is_a_case_like_others(tmp_path):
    (case,) = toy_cases(tmp_path, "recurrent")
    run_case(case)
    assert case.done
    assert len(json.loads((case.folder / "scores.json").read_text())["scores"]) == 3


def test_cases():
    cases = planned(Path())
    assert len(cases) == 6 * 6 * 5 + 4 * 2 * 3 + 2 * 2
    assert len({case.folder for case in cases}) == len(cases)
    assert {(case.system, case.measurement_noise) for case in cases} >= set(MORE_NOISE.items())
    assert {case.information for case in cases} == set(COMPARED)


def test_normalised_scores_by_hand():
    assert normalised(np.array([-0.1, -0.3, -0.4]), -0.2, -0.6).tolist() == pytest.approx([1.25, 0.75, 0.5])
    assert np.isnan(normalised(np.array([-0.1]), -0.6, -0.6)).all()  # the best is no better than nothing


def test_interquartile_means_and_intervals():
    assert middle(np.array([0.0, 1.0, 2.0, 3.0, 100.0])) == 2.0
    best = np.array([0.0, 0.0, 0.0, 0.0])
    found, low, high = interval(np.array([-0.2, -0.3, -0.4, -0.5]), best, -1.0)
    assert found == pytest.approx(0.65)
    assert 0.5 <= low < found < high <= 0.8
    varied = np.array([-0.2, -0.1, 0.1, 0.2])
    assert interval(varied, varied, -1.0)[0] == 1.0
    wider = interval(np.array([-0.2, -0.3, -0.4, -0.5]), varied, -1.0)
    assert wider[2] - wider[1] > high - low  # those that it is measured by are uncertain, too
    assert np.isnan(interval(np.array([-0.2, -0.3]), best, -1.0)[1:]).all()


def test_wrong_numbers(tmp_path):
    with pytest.raises(ValueError, match="must be positive"):
        toy(tmp_path, seeds=0).run(Console())
    for wrong in (
        {"systems": ("lorenz", "lorenz")},
        {"information": ("y", "y")},
        {"information": ()},
    ):
        with pytest.raises(ValueError, match="each once"):
            toy(tmp_path, **wrong).run(Console())
    for wrong, message in (
        ({"systems": ("mine.py:Mine",)}, "no file mine.py"),
        ({"observers": ("rossler",)}, "the observer rossler is for rossler: name one for each of lorenz at most"),
        ({"observers": ("lorenz", "lorenz-small")}, "the observer lorenz-small is for lorenz"),
    ):
        with pytest.raises(ValueError, match=message):
            toy(tmp_path, **wrong).run(Console())


def test_a_system_and_an_observer_of_ones_own(tmp_path, saved, capsys):
    own = f"{linear_system.__file__}:Oscillator"
    with pytest.raises(ValueError, match="no observer ships for 'oscillator'"):
        toy(tmp_path, systems=(own,), information=("x_hat",), seeds=1).run(Console())
    options = {"information": ("state", "x_hat"), "seeds": 1, "observers": (saved(system=own),)}
    toy(tmp_path, systems=(own,), **options).run(Console())
    results = pd.read_csv(tmp_path / "results.csv")
    assert results[["system", "knows"]].to_numpy().tolist() == [["oscillator", "state"], ["oscillator", "x_hat"]]
    table = (tmp_path / "table.md").read_text()
    assert "| oscillator, noise 0.1 |" in table  # the system's own
    assert f"Partial: {6 * 5 + 2 * 3 - 2} of {6 * 5 + 2 * 3} agents are missing" in table
    assert "finished oscillator at noise 0.1/x_hat/0" in (tmp_path / "log.txt").read_text()


def test_an_interrupted_training_is_of_one_comparison_as_well(tmp_path, monkeypatch):
    def interrupted(case):
        raise KeyboardInterrupt

    (case,) = toy_cases(tmp_path, "y")
    with monkeypatch.context() as patch:
        patch.setattr(examples.research.agents.comparison, "_run", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_case(case)
    assert not case.done
    with pytest.raises(ValueError, match="of another comparison: episodes = 3 there, 4 here"):
        run_case(replace(case, episodes=4))
    run_case(case)
    assert case.done


def test_one_agent_is_not_trained_twice_at_a_time(tmp_path):
    (case,) = toy_cases(tmp_path, "y")
    with locked(case.folder), pytest.raises(ValueError, match="another process is at work"):
        run_case(case)


def test_the_published_table_follows_from_the_published_results(tmp_path):
    published = Path(__file__).parents[3] / "docs" / "results" / "agents"
    shutil.copy(published / "results.csv", tmp_path)
    report(tmp_path)
    assert (tmp_path / "table.md").read_text() == (published / "table.md").read_text()


def test_noise_of_each_output_has_a_name(tmp_path):
    rows = [
        {"system": system, "noise": noise, "knows": "state", "seed": 0, "score": -0.2, "success": 0.5, "idle": -0.6,
         "seconds": 60.0}
        for system, noise in (("lorenz", 2.0), ("two", "0.1-0.02"))
    ]  # fmt: skip
    pd.DataFrame(rows).to_csv(tmp_path / "results.csv", index=False)
    report(tmp_path)
    assert "| lorenz, noise 2 | two, noise 0.1-0.02 |" in (tmp_path / "table.md").read_text()
