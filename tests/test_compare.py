"""The comparison of agents, at toy size."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from training.agents.compare import KNOWS, MORE_NOISE, Compare, interval, normalised, report, run_case


def toy(out, **options):
    settings = {"systems": ("lorenz",), "seeds": 2, "episodes": 3, "timesteps": 1, "more_noise": False, "jobs": 1}
    return Compare(out=out, **{**settings, **options})


def test_a_comparison_resumes_and_says_what_is_missing(tmp_path, capsys):
    out = tmp_path / "a"
    toy(out, knows=("state", "y")).run(Console())
    results = pd.read_csv(out / "results.csv")
    assert len(results) == 4
    assert (results.score <= 0).all()
    assert np.isfinite(results.to_numpy()[:, 4:].astype(float)).all()
    table = (out / "table.md").read_text()
    assert "| full state | 1.00" in table
    assert "Partial" not in table
    assert (out / "scores.png").stat().st_size > 1000
    before = {path: path.stat().st_mtime_ns for path in out.glob("jobs/**/result.json")}
    shutil.rmtree(out / "jobs" / "lorenz-0.5" / "y" / "1")
    toy(out, knows=("state", "y")).run(Console())
    again = pd.read_csv(out / "results.csv")
    assert again.drop(columns="seconds").equals(results.drop(columns="seconds"))  # all is seeded
    changed = [path for path in before if path.stat().st_mtime_ns != before[path]]
    assert [path.parts[-3:-1] for path in changed] == [("y", "1")]
    report(out, 5)
    assert "Partial: 4 of 5 agents" in (out / "table.md").read_text()
    with pytest.raises(ValueError, match="of another comparison"):
        toy(out, knows=("y",), episodes=4).run(Console())


def test_a_recurrent_agent_is_a_case_like_others(tmp_path):
    (case,) = toy(tmp_path, knows=("recurrent",), seeds=1).cases()
    run_case(case)
    assert case.done
    assert len(json.loads((case.folder / "result.json").read_text())["scores"]) == 3


def test_cases():
    cases = Compare().cases()
    assert len(cases) == 6 * (6 * 5 + 2 * 3)
    assert len({case.folder for case in cases}) == len(cases)
    assert {(case.system, case.measurement_noise) for case in cases} >= set(MORE_NOISE.items())
    assert {case.knows for case in cases} == set(KNOWS)


def test_normalised_scores_by_hand():
    results = pd.DataFrame(
        {
            "system": "lorenz",
            "noise": 0.5,
            "knows": ["state", "state", "y"],
            "score": [-0.1, -0.3, -0.4],
            "idle": -0.6,
        }
    )
    assert normalised(results).normalised.tolist() == pytest.approx([1.25, 0.75, 0.5])


def test_interquartile_mean_and_interval():
    middle, low, high = interval(np.array([0.0, 1.0, 2.0, 3.0, 100.0]))
    assert middle == 2.0
    assert 0 <= low <= middle <= high
    assert interval(np.array([0.7])) == (0.7, 0.7, 0.7)


def test_wrong_numbers(tmp_path):
    with pytest.raises(ValueError, match="must be positive"):
        toy(tmp_path, seeds=0).run(Console())
