"""The benchmark's protocol, jobs, tables and command."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import research
from matplotlib.image import imread

from examples.research.benchmark.jobs import Training
from examples.research.benchmark.protocol import Protocol, component_smape, measure, validate
from examples.research.methods import Budget, Method, get_method
from examples.research.resumable import run_job
from kkl_gym import get_system
from observers.estimator import Estimate
from training.evaluation.errors import unseen_trajectories
from training.evaluation.metrics import nrmse, smape
from training.seeds import Stream

TINY = Budget("tiny", trajectories=8, duration=20.0, samples=10, cpu_seconds=1e9, width=8, depth=1, dt=0.05, steps=3)
SHORT = Protocol(trajectories=2, duration=2.0)
RESULTS = Path(__file__).parents[2] / "docs" / "results"

TOY = '''
from pathlib import Path

import numpy as np

from examples.research.methods import Method
from observers.estimator import Estimate


class Constant(Method):
    """The mean of the training states, whatever y is."""

    name = "constant"
    label = "constant mean"

    def configurations(self, system):
        return ({"shift": 1.0}, {"shift": 0.0}, {"shift": 2.0})

    def train(self, task, configuration):
        with (Path(__file__).parent / "trainings").open("a") as log:
            print(task.system.name, configuration["shift"], file=log)
        return {"mean": task.data.x.mean((0, 1)) + configuration["shift"] * np.array(task.system.scale)}

    def observer(self, trained, system, dt, noise):
        return Held(trained["mean"])


class Held:
    def __init__(self, mean):
        self.mean = mean

    def start(self, n):
        return n

    def advance(self, state, y, u=None, dt=None):
        return state

    def estimate(self, state):
        return Estimate(np.tile(self.mean, (state, 1)))
'''


@pytest.fixture
def toy(tmp_path):
    """A script with methods of a user's, and the log of their trainings."""
    folder = tmp_path / "user"
    folder.mkdir()
    (folder / "toy.py").write_text(TOY)
    return folder / "toy.py", folder / "trainings"


def rows_of(page, title):
    """The first table under a title of a Markdown page: the header, then rows of cells by their first one."""
    lines = page.split(f"\n## {title}\n")[1].split("\n## ")[0].splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
    return cells[0][1:], {first: rest for first, *rest in cells[2:]}


def test_the_notebooks_measure_by_hand():
    x = np.array([[[3.0, 4.0]], [[0.0, 2.0]]])
    x_hat = np.array([[[0.0, 0.0]], [[0.0, 1.0]]])
    assert component_smape(x, x_hat)[0] == pytest.approx((200 + 200 + 0 + 200 / 3) / 4)


def test_a_quick_run_of_two_methods_stands_beside_an_earlier_one(toy, tmp_path):
    """Also a narrower run, a report alone and a run of other settings."""
    (script, log), first, second = toy, tmp_path / "first", tmp_path / "second"
    quick = ("benchmark", "--quick", "--systems", "lorenz", "--jobs", "1", "--methods")
    research(*quick, "ekf", "--out", str(first))
    options = (*quick, f"{script}:Constant", "--out", str(second))
    research(*options, "--beside", str(first))
    results, methods = (pd.read_csv(second / f"{name}.csv") for name in ("results", "methods"))
    assert results.groupby(["system", "method"]).size().to_dict() == {
        ("lorenz", "constant"): 30,
        ("lorenz", "ekf"): 30,
    }
    kept = (first / "results.csv").read_text().splitlines()
    assert (second / "results.csv").read_text().splitlines()[: len(kept)] == kept  # digit by digit
    assert (methods.us_batch_1 > 0).all()
    page = (second / "table.md").read_text()
    assert imread(second / "heatmap.png").shape[1] > 300

    x = unseen_trajectories(get_system("lorenz"), 0.01, n=5, duration=10.0, seed=0).x
    trained = second / "jobs" / "lorenz" / "constant" / "trained.safetensors"
    mean = get_method(f"{script}:Constant").load(trained)["mean"]
    row = results[(results.method == "constant") & (results.starts == "X") & (results.noise == 0)]
    x_hat = np.broadcast_to(mean, x.shape)
    np.testing.assert_allclose(row.smape, smape(x, x_hat), rtol=1e-3)
    expected = nrmse(x, x_hat, skip=round(0.2 * len(x)))
    np.testing.assert_allclose(row[["nrmse1", "nrmse2", "nrmse3"]], expected, rtol=1e-3)
    _, cells = rows_of(page, "NRMSE in % after the first 20 %, starts in X, noise 0")
    shown = [float(figure) for figure in cells["constant mean"][0].split(" / ")]
    np.testing.assert_allclose(shown, np.median(expected, 0), rtol=6e-3)

    trainings, before = log.read_text(), {path: path.read_bytes() for path in second.glob("*.[cm]*")}
    research(*options, "--beside", str(first))
    assert log.read_text() == trainings  # nothing was trained again
    assert {path: path.read_bytes() for path in before} == before
    with pytest.raises(SystemExit, match="holds results of another benchmark: protocol"):
        research(*options, "--seed", "1")
    with pytest.raises(SystemExit, match="does not exist; run the benchmark first"):
        research(*options, "--beside", str(tmp_path))


def job(toy, tmp_path, name="Constant", **changes):
    settings = {"system": "lorenz", "method": f"{toy[0]}:{name}", "folder": tmp_path / "job", "budget": TINY}
    return Training(**{**settings, "protocol": SHORT, "search": 1e9, "validation": SHORT, **changes})


def test_the_configuration_with_the_least_validation_error_is_trained(toy, tmp_path):
    one = job(toy, tmp_path)
    run_job(one)
    info = json.loads((one.folder / "info.json").read_text())
    assert info["configuration"] == {"shift": 0.0}
    assert info["validation"][1] == min(info["validation"])
    shifts = [line.split()[1] for line in toy[1].read_text().splitlines()]
    assert shifts == ["1.0", "0.0", "2.0", "0.0"]  # three short trainings and the full one
    run_job(one)
    assert len(toy[1].read_text().splitlines()) == 4
    with pytest.raises(ValueError, match="holds results of another benchmark: budget"):
        run_job(job(toy, tmp_path, budget=Budget(**{**vars(TINY), "samples": 11})))
    toy[0].write_text(toy[0].read_text().replace("x.mean", "x.max"))
    changed = toy[0].rename(toy[0].with_name("changed.py"))
    with pytest.raises(ValueError, match="another benchmark: code"):
        run_job(job((changed,), tmp_path))


def test_impossible_benchmarks(tmp_path):
    for wrong, message in (
        ("--systems lorentz", "unknown system 'lorentz'"),
        ("--methods kalman", "unknown method 'kalman'"),
        ("--methods ekf ekf", "name each .* once"),
        ("--report", "does not exist; run the benchmark first"),
    ):
        with pytest.raises(SystemExit, match=message):
            research("benchmark", *wrong.split(), "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out" / "jobs").exists()


class Oracle(Method):
    """Knows the trajectories of one case; some rows are wrong at will."""

    name, label = "oracle", "oracle"

    def __init__(self, x, wrong=()):
        self.x, self.wrong, self.seen = x, wrong, []

    def train(self, task, configuration):
        raise AssertionError

    def observer(self, trained, system, dt, noise):
        self.seen.append((noise, []))
        return self

    def start(self, n):
        return -1

    def advance(self, state, y, u=None, dt=None):
        self.seen[-1][1].append(y)
        return state + 1

    def estimate(self, state):
        x = self.x[state].copy()
        for row, value in self.wrong:
            x[row] = value
        return Estimate(x)


def test_measure_marks_the_lost_and_the_escaped_and_adds_noise():
    system, dt = get_system("rossler"), 0.01
    runs = unseen_trajectories(system, dt, n=100, duration=20.0, seed=0, domain="2X")
    assert runs.escaped > 0
    oracle = Oracle(runs.x, wrong=((0, np.nan), (1, 1e6)))
    protocol = Protocol(domains=("2X",), trajectories=100, duration=20.0)
    frame = measure(oracle, None, system, dt=dt, protocol=protocol)
    assert len(frame) == 200
    exact = frame[frame.noise == 0]
    escaped, inside = exact[exact.escaped == 1], exact[exact.escaped == 0]
    assert escaped.trajectory.tolist() == np.flatnonzero(~runs.inside).tolist()
    assert escaped[["smape", "nrmse3"]].isna().all(axis=None)
    assert inside.lost.tolist() == [1.0, 1.0] + [0.0] * (len(inside) - 2)
    assert inside.smape.iloc[0] == 200.0
    assert (inside[["smape", "nrmse1", "nrmse2", "nrmse3"]][2:] == 0).all(axis=None)
    (none, quiet), (some, noisy) = oracle.seen
    np.testing.assert_array_equal(quiet, system.output(runs.x))
    assert (np.array(noisy) - quiet).std() == pytest.approx(0.5, rel=0.05)
    assert (none, some) == (0.0, 0.5)


def test_validation_trajectories_are_not_those_of_evaluation():
    system = get_system("lorenz")
    evaluation, exact = (
        unseen_trajectories(system, 0.01, n=5, duration=0.1, seed=0, stream=stream).x
        for stream in (Stream.EVALUATION, Stream.VALIDATION)
    )
    assert np.abs(evaluation[0] - exact[0]).min() > 1e-3
    how = {"system": system, "dt": 0.01, "protocol": Protocol(trajectories=5, duration=0.1)}
    assert validate(Oracle(exact), None, **how) == pytest.approx(1e-6)
    assert validate(Oracle(2 * exact), None, **how) == pytest.approx(100 * 2 / 3)
    particular = Oracle(exact)
    particular.tuned_for = (0.25,)
    validate(particular, None, **how)
    assert [noise for noise, _ in particular.seen] == [0.125]  # of the 0.5 that are the system's own


@pytest.mark.research
@pytest.mark.parametrize("name", ["benchmark", "ablation"])
def test_committed_results_give_the_committed_table_and_figure(name, tmp_path):
    for file in ("results.csv", "methods.csv"):
        shutil.copy(RESULTS / name / file, tmp_path)
    research("benchmark", "--report", "--out", str(tmp_path))
    assert (tmp_path / "table.md").read_text() == (RESULTS / name / "table.md").read_text()
    drawn, committed = (imread(folder / "heatmap.png") for folder in (tmp_path, RESULTS / name))
    assert drawn.shape == committed.shape
    assert np.abs(drawn[..., :3] - committed[..., :3]).mean() < 0.01  # which has fewer colours
