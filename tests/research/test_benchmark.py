"""The benchmark's protocol, jobs, tables and command."""

import json
import math
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from filelock import FileLock
from matplotlib.image import imread
from matplotlib.text import Text
from rich.console import Console

import examples.research.benchmark.jobs
import examples.research.speed.size_errors as sizes
from examples.research.benchmark import protocol as protocol_module
from examples.research.benchmark.command import Benchmark
from examples.research.benchmark.jobs import OTHER, Job, run_job
from examples.research.benchmark.protocol import Protocol, measure, run, step_time, validate, with_shared_noise
from examples.research.benchmark.results import collect
from examples.research.benchmark.tables import _number, heatmap, summarise
from examples.research.methods import METHODS, Budget, Method, get_method
from kkl_gym import SYSTEMS, get_system
from training.cli import main
from training.commands.running import Workers
from training.evaluation.errors import starts, unseen_trajectories
from training.evaluation.metrics import component_smape, nrmse, rmse, settling_time, smape
from training.jobs import claimed_job
from training.parallel import engine
from training.seeds import Stream

TINY = Budget("tiny", trajectories=8, duration=20.0, samples=10, cpu_seconds=1e9, width=8, depth=1, dt=0.05, steps=3)
SHORT = Protocol(trajectories=2, duration=2.0)
RESULTS = Path(__file__).parents[3] / "docs" / "results"


def run_all(jobs, workers):
    with engine(workers) as here:
        return list(here.run(run_job, jobs))


TOY = '''
from pathlib import Path

import numpy as np

from examples.research.methods import Method


class Constant(Method):
    """The mean of the training states, whatever y says."""

    name = "constant"
    label = "constant mean"

    def configurations(self, system):
        return ({"shift": 1.0}, {"shift": 0.0}, {"shift": 2.0})

    def train(self, task, configuration):
        with (Path(__file__).parent / "trainings").open("a") as log:
            log.write(f"{task.system.name} {configuration['shift']}\\n")
        return {"mean": task.data.x.mean((0, 1)) + configuration["shift"] * np.array(task.system.scale)}

    def observer(self, trained, system, dt, noise):
        return Held(trained["mean"])


class Held:
    def __init__(self, mean):
        self.mean = mean

    def reset(self, y0):
        return np.tile(self.mean, (len(y0), 1))

    def step(self, y):
        return np.tile(self.mean, (len(y), 1))
'''


EXPLOSIVE = """

class Explosive(Constant):
    name = "explosive"

    def train(self, task, configuration):
        task.folder.joinpath("half-done").touch()
        raise FloatingPointError("the error of stage 'one' is not a number")
"""


BROKEN = """

class Broken(Constant):
    name = "broken"

    def train(self, task, configuration):
        return 1 / 0
"""


WRONG = """

from examples.research.methods import WrongParameters


class Wrong(WrongParameters, Constant):
    name = "wrong"

    def train(self, task, configuration):
        with (Path(__file__).parent / "trainings").open("a") as log:
            print(task.system.parameters, file=log)
        return {"mean": task.data.x.mean((0, 1))}
"""


@pytest.fixture
def toy(tmp_path):
    """A user's method in a script of its own, and the log of its trainings."""
    folder = tmp_path / "user"
    folder.mkdir()
    (folder / "toy.py").write_text(TOY)
    return f"{folder / 'toy.py'}:Constant", folder / "trainings"


@pytest.fixture
def tiny(monkeypatch):
    """The command at toy size."""
    monkeypatch.setitem(sizes.BUDGETS, "cpu", TINY)
    monkeypatch.setitem(sizes.BUDGETS, "quick", TINY)
    monkeypatch.setattr(sizes, "PROTOCOL", SHORT)
    monkeypatch.setattr(sizes, "QUICK_PROTOCOL", SHORT)
    monkeypatch.setattr(sizes, "VALIDATION", SHORT)
    monkeypatch.setattr(examples.research.benchmark.jobs, "step_time", lambda *_, **__: 1.0)


def quiet():
    return Console(quiet=True)


def test_metrics_by_hand():
    x = np.array([[[3.0, 4.0]], [[3.0, 4.0]], [[3.0, 4.0]], [[0.0, 0.0]]])
    x_hat = np.array([[[0.0, 0.0]], [[3.0, 0.0]], [[3.0, 4.0]], [[0.0, 0.0]]])
    assert smape(x, x_hat) == pytest.approx([100 * (2 + 2 * 4 / 8 + 0 + 0) / 4])
    assert smape(x, x_hat, skip=1) == pytest.approx([100 * (2 * 4 / 8 + 0 + 0) / 3])
    assert component_smape(x, x_hat) == pytest.approx([100 * (2 + 2 + 0 + 2 + 0 + 0 + 0 + 0) / 8])
    assert component_smape(x, x_hat, skip=2) == pytest.approx([0.0])
    assert rmse(x, x_hat) == pytest.approx([math.sqrt((25 + 16) / 4)])
    assert rmse(x, x_hat, skip=1) == pytest.approx([math.sqrt(16 / 3)])
    # The root mean square of |x| is sqrt(75 / 4); errors 5 and 4 are above a tenth of it, 0 is below.
    assert settling_time(x, x_hat, dt=0.5) == pytest.approx([1.0])
    assert settling_time(x, x, dt=0.5) == pytest.approx([0.0])
    assert settling_time(x, x[::-1], dt=0.5) == pytest.approx([math.inf])


def test_estimates_that_are_not_finite_count_as_infinitely_far():
    x = np.ones((4, 3, 2))
    x_hat = x.copy()
    x_hat[3, 0, 0], x_hat[3, 1, 0] = np.nan, np.inf
    assert smape(x, x_hat) == pytest.approx([50.0, 50.0, 0.0])
    assert component_smape(x, x_hat) == pytest.approx([25.0, 25.0, 0.0])
    assert rmse(x, x_hat).tolist() == [math.inf, math.inf, 0.0]
    assert settling_time(x, x_hat, 0.1).tolist() == [math.inf, math.inf, 0.0]


class Oracle(Method):
    """Knows the trajectories of one case; broken ones at will."""

    name, label = "oracle", "oracle"

    def __init__(self, x, wrong=()):
        self.x, self.wrong = x, wrong

    def train(self, task, configuration):
        raise AssertionError

    def observer(self, trained, system, dt, noise):
        return self

    def reset(self, y0):
        self.k = -1
        return self.step(y0)

    def step(self, y):
        self.k += 1
        x = self.x[self.k].copy()
        for row, value in self.wrong:
            x[row] = value
        return x


def test_measure_marks_the_lost_and_the_escaped():
    system, dt = get_system("rossler"), 0.01
    protocol = Protocol(domains=("2X",), measurement_noise=(0.0,), trajectories=100, duration=20.0)
    runs = unseen_trajectories(system, dt, n=100, duration=20.0, seed=0, domain="2X")
    assert runs.escaped > 0
    frame = measure(Oracle(runs.x, wrong=((0, np.nan), (1, 1e6))), None, system, dt=dt, protocol=protocol)
    assert len(frame) == 100
    escaped = frame[frame.escaped == 1]
    assert escaped.trajectory.tolist() == np.flatnonzero(~runs.inside).tolist()
    assert escaped.smape.isna().all()
    inside = frame[frame.escaped == 0]
    assert inside.lost.tolist() == [1.0, 1.0] + [0.0] * (len(inside) - 2)
    assert (inside.smape[2:] == 0).all()
    assert inside.smape.iloc[0] == 200.0
    nrmse = inside[["nrmse1", "nrmse2", "nrmse3"]].to_numpy()
    assert (nrmse[0] == math.inf).all()
    np.testing.assert_allclose(nrmse[1], 100 * rms(1e6 - runs.x[:, 1], skip=20 * 20) / runs.x.std((0, 1)))
    assert (nrmse[2:] == 0).all()
    assert escaped.nrmse3.isna().all()


def rms(error, skip):
    return np.sqrt((error[skip:] ** 2).mean(0))


def test_methods_that_are_slow_get_the_first_trajectories():
    system, dt = get_system("van_der_pol"), 0.05
    many = unseen_trajectories(system, dt, n=100, duration=1.0, seed=0, domain="X")
    runs = many.first(2)
    assert runs.inside.tolist() == [True, True]
    method = Oracle(runs.x)
    method.trajectories = 2
    frame = measure(method, None, system, dt=dt, protocol=Protocol(domains=("X",), trajectories=100, duration=1.0))
    assert len(frame) == 2 * 2
    np.testing.assert_array_equal(many.x[:, :2], runs.x)
    few, all_of_them = (
        with_shared_noise(system, one, measurement_noise=0.5, n=100, seed=(Stream.EVALUATION, 0))
        for one in (runs, many)
    )
    np.testing.assert_array_equal(all_of_them[:, :2], few)


def test_observers_see_noise_of_the_level_and_one_sample_at_a_time():
    system, seen = get_system("lorenz"), []

    class Spy(Oracle):
        def observer(self, trained, system, dt, noise):
            self.told = noise
            return self

        def reset(self, y0):
            seen.append([])
            return super().reset(y0)

        def step(self, y):
            seen[-1].append(y)
            return super().step(y)

    runs = unseen_trajectories(system, 0.01, n=20, duration=2.0, seed=0, domain="X")
    method = Spy(runs.x)
    measure(method, None, system, dt=0.01, protocol=Protocol(domains=("X",), trajectories=20, duration=2.0))
    quiet_y, noisy_y = (np.array(record) for record in seen)
    np.testing.assert_array_equal(quiet_y, system.output(runs.x))
    assert (noisy_y - quiet_y).std() == pytest.approx(0.5, rel=0.05)
    assert method.told == 0.5


def test_validation_trajectories_are_not_those_of_evaluation():
    system = get_system("lorenz")
    evaluation, validation = (
        unseen_trajectories(system, 0.01, n=5, duration=0.1, seed=0, stream=stream).x
        for stream in (Stream.EVALUATION, Stream.VALIDATION)
    )
    assert np.abs(evaluation[0] - validation[0]).min() > 1e-3
    exact = unseen_trajectories(system, 0.01, n=5, duration=0.1, seed=0, stream=Stream.VALIDATION).x
    protocol = Protocol(measurement_noise=(0.0, 0.5), trajectories=5, duration=0.1)
    assert validate(Oracle(exact), None, system, dt=0.01, protocol=protocol) == pytest.approx(1e-6)
    double = validate(Oracle(2 * exact), None, system, dt=0.01, protocol=protocol)
    assert double == pytest.approx(100 * 2 / 3)


def test_methods_made_for_one_noise_level_are_validated_there():
    system, asked = get_system("lorenz"), []

    class Particular(Oracle):
        tuned_for = (0.25,)

        def observer(self, trained, system, dt, noise):
            asked.append(noise)
            return self

    protocol = Protocol(measurement_noise=(0.0, 0.5), trajectories=2, duration=0.1)
    exact = unseen_trajectories(system, 0.01, n=2, duration=0.1, seed=0, stream=Stream.VALIDATION).x
    validate(Particular(exact), None, system, dt=0.01, protocol=protocol)
    assert asked == [0.125]  # of the 0.5 that are the system's own


@pytest.mark.parametrize("domain", ["1.5X", "2X"])
def test_starts_outside_x_lie_between_the_boxes(domain):
    system = get_system("rossler")
    x0 = starts(system, domain, 500, np.random.default_rng(0))
    low, high = system.box()
    assert ((x0 < low) | (x0 > high)).any(-1).all()
    low, high = system.box(float(domain[:-1]))
    assert ((x0 >= low) & (x0 <= high)).all()
    assert (x0.max(0) > 0.9 * high).all()


def test_step_time_is_that_of_the_fastest_round_and_of_whole_batches(monkeypatch):
    class Slow(Oracle):
        """Of an imagined clock steps take 1/64 s, then 1/256 s; resetting takes a second."""

        now, batches = 0.0, []

        def process_time(self):
            return self.now

        def reset(self, y0):
            self.now += 1.0

        def step(self, y):
            self.batches.append(y.shape)
            self.now += 1 / 64 if len(self.batches) <= 104 else 1 / 256

    method = Slow(None)
    monkeypatch.setattr(protocol_module, "time", method)
    found = step_time(method, None, system=get_system("lorenz"), dt=0.01, batch=7, seconds=5 / 16)
    assert found == 1e6 / 256
    assert set(method.batches) == {(7, 1)}
    assert len(method.batches) == 5 * 100 + 4 + 4 * 16  # a fifth of the time in each round, after what is not timed


def test_a_toy_method_takes_one_class(toy, tiny, tmp_path):
    name, trainings = toy
    out = tmp_path / "out"
    Benchmark(systems=("van_der_pol", "lorenz"), methods=(name, "ekf-untuned"), out=out, workers=Workers(1)).run(
        quiet()
    )
    results = pd.read_csv(out / "results.csv")
    assert results.groupby(["system", "method"]).size().tolist() == [12] * 4
    expected = unseen_trajectories(get_system("lorenz"), TINY.dt, n=2, duration=2.0, seed=0).x
    info = json.loads((out / "jobs" / "lorenz" / "constant" / "info.json").read_text())
    assert info["configuration"] == {"shift": 0.0}  # the sensible one of the three won on validation
    assert info["validation"][1] == min(info["validation"])
    mean = get_method(name).load(out / "jobs" / "lorenz" / "constant" / "trained.safetensors")["mean"]
    row = results[(results.system == "lorenz") & (results.method == "constant") & (results.starts == "X")]
    found = row[row.noise == 0].smape.to_numpy()
    np.testing.assert_allclose(found, smape(expected, np.broadcast_to(mean, expected.shape)), rtol=1e-3)
    table = (out / "table.md").read_text()
    assert "| constant mean |" in table
    expected = nrmse(expected, np.broadcast_to(mean, expected.shape), skip=8)
    np.testing.assert_allclose(row[row.noise == 0][["nrmse1", "nrmse2", "nrmse3"]], expected, rtol=1e-3)
    _, cells = rows_of(table, "NRMSE in % after the first 20 %, starts in X, noise 0")
    of_two, of_three = (cell.split(" / ") for cell in cells["constant mean"])
    assert (len(of_two), len(of_three)) == (2, 3)
    np.testing.assert_allclose([float(figure) for figure in of_three], np.median(expected, 0), rtol=6e-3)
    every, more = 4 * (len(METHODS) + 1), len(METHODS) - 3  # four are named, and reverse Duffing and Rössler lack mine
    assert f"Partial: 4 of {every} observers. Missing: default; spinn; ae; dmf and {more} more methods." in table
    assert imread(out / "heatmap.png").shape[1] > 300
    assert len(trainings.read_text().splitlines()) == 2 * 4  # three configurations and the final one


def test_a_run_goes_on_where_it_stopped(toy, tiny, tmp_path):
    name, trainings = toy
    out, script = tmp_path / "out", Path(name.rpartition(":")[0])
    stop = script.parent / "stop"
    script.write_text(
        script.read_text().replace(
            '        return {"mean"',
            '        if task.system.name == "lorenz" and Path(__file__).with_name("stop").exists():\n'
            "            raise KeyboardInterrupt\n"
            '        return {"mean"',
        )
    )
    benchmark = Benchmark(systems=("van_der_pol", "lorenz"), methods=(name,), out=out, workers=Workers(1))
    stop.touch()
    with pytest.raises(KeyboardInterrupt):
        benchmark.run(quiet())
    begun = trainings.read_text().split()
    assert (begun.count("van_der_pol"), begun.count("lorenz")) == (4, 1)
    stop.unlink()
    benchmark.run(quiet())
    after = trainings.read_text().split()
    assert (after.count("van_der_pol"), after.count("lorenz")) == (4, 5)  # the one interrupted was begun anew
    results = (out / "results.csv").read_bytes()
    benchmark.run(quiet())
    assert trainings.read_text().split() == after
    assert (out / "results.csv").read_bytes() == results


def test_a_job_that_another_process_works_on_is_left_alone(toy, tmp_path):
    name, trainings = toy
    job = Job("lorenz", name, tmp_path / "job", TINY, SHORT, None, SHORT)
    job.folder.mkdir()
    with FileLock(job.folder / ".lock"):
        ((_, failure),) = run_all([job], 1)
    assert "another process is at work" in failure
    assert not trainings.exists()


def test_a_training_that_blows_up_leaves_no_checkpoint(toy, tmp_path):
    name, _ = toy
    script = Path(name.rpartition(":")[0])
    script.write_text(script.read_text() + EXPLOSIVE)
    job = Job("lorenz", f"{script}:Explosive", tmp_path / "job", TINY, SHORT, 1.0, SHORT)
    ((_, failure),) = run_all([job], 1)
    assert "is not a number" in failure
    assert not any(path.is_dir() for path in job.folder.iterdir())


def test_a_search_goes_on_where_it_stopped(toy, tmp_path):
    name, trainings = toy
    job = Job("lorenz", name, tmp_path / "job", TINY, SHORT, 1.0, SHORT)
    with claimed_job(job.folder, job.identity, OTHER):
        pass
    (job.folder / "configuration-0.json").write_text('{"configuration": {"shift": 1.0}, "score": 1e-9}')
    assert [failure for _, failure in run_all([job], 1)] == [None]
    # The others, what was settled in a short training of the best (its file is missing), and the full training.
    assert trainings.read_text().split() == ["lorenz", "0.0", "lorenz", "2.0", "lorenz", "1.0", "lorenz", "1.0"]


@pytest.mark.parametrize(("file", "text"), [
    ("configuration-0.json", "{"), ("configuration-0.json", "[]"), ("configuration-0.json", '{"configuration": {}}'),
    ("trained.seconds", ""), ("trained.seconds", "a minute"),
])  # fmt: skip
def test_what_an_earlier_run_left_damaged_is_named(file, text, toy, tmp_path):
    job = Job("lorenz", toy[0], tmp_path / "job", TINY, SHORT, 1.0, SHORT)
    assert [failure for _, failure in run_all([job], 1)] == [None]
    (job.folder / "errors.csv").unlink()
    (job.folder / file).write_text(text)
    ((_, failure),) = run_all([job], 1)
    assert str(job.folder / file) in failure


@pytest.mark.parametrize(("file", "text"), [
    ("errors.csv", ""), ("info.json", "{"), ("info.json", "{}"), ("job.json", "[]"), ("speed.json", "[1]"),
])  # fmt: skip
def test_results_that_are_damaged_are_named(file, text, toy, tiny, tmp_path):
    out = Benchmark(systems=("lorenz",), methods=(toy[0],), out=tmp_path / "out", workers=Workers(1)).run(quiet())
    folder = out / "jobs" / "lorenz" / "constant"
    (folder / file).write_text(text)
    with pytest.raises(ValueError, match=re.escape(str(folder))):
        collect(out)


def test_a_failure_leaves_the_others(toy, tiny, tmp_path):
    name, _ = toy
    script = Path(name.rpartition(":")[0])
    script.write_text(script.read_text() + BROKEN)
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="1 of 2 jobs failed; the first: lorenz/broken"):
        Benchmark(systems=("lorenz",), methods=(f"{script}:Broken", name), out=out, workers=Workers(1)).run(quiet())
    assert set(pd.read_csv(out / "methods.csv").method) == {"constant"}
    assert "in train" in (out / "jobs" / "lorenz" / "broken" / "failure.txt").read_text()


def test_wrong_methods_are_trained_on_another_system_than_they_see(toy, tiny, tmp_path, monkeypatch):
    name, trainings = toy
    script = Path(name.rpartition(":")[0])
    script.write_text(script.read_text() + WRONG)
    seen, measured = examples.research.benchmark.jobs.measure, []
    monkeypatch.setattr(
        examples.research.benchmark.jobs,
        "measure",
        lambda *its, **how: measured.append(its[2].parameters) or seen(*its, **how),
    )
    Benchmark(
        quick=True, systems=("van_der_pol",), methods=(f"{script}:Wrong",), out=tmp_path / "out", workers=Workers(1)
    ).run(quiet())
    assert trainings.read_text().splitlines() == ["{'mu': 3.3000000000000003}"]
    assert measured == [{"mu": 3.0}]


def test_wrong_methods_need_parameters(tiny, tmp_path):
    pendulum = tmp_path / "slow.py"
    pendulum.write_text(SLOW)
    options = {"quick": True, "systems": (f"{pendulum}:Slow",), "out": tmp_path / "out", "workers": Workers(1)}
    with pytest.raises(ValueError, match="slow has no parameters that could be off"):
        Benchmark(methods=("ekf", "ekf-wrong"), **options).run(quiet())
    assert not (tmp_path / "out" / "jobs").exists()
    jobs = Benchmark(**options)._jobs("quick", tmp_path / "out")
    assert [job.method for job in jobs] == [method for method in METHODS if not method.endswith("-wrong")]


def test_results_of_another_benchmark_are_not_mixed_in(toy, tiny, tmp_path, monkeypatch):
    name, _ = toy
    out = tmp_path / "out"
    Benchmark(systems=("lorenz",), methods=(name,), out=out, workers=Workers(1)).run(quiet())
    monkeypatch.setitem(sizes.BUDGETS, "cpu", Budget(**{**vars(TINY), "samples": 11}))
    with pytest.raises(ValueError, match="holds results of another benchmark: budget"):
        Benchmark(systems=("lorenz",), methods=("ekf-untuned", name), out=out, workers=Workers(1)).run(quiet())
    assert not (out / "jobs" / "lorenz" / "ekf-untuned").exists()  # nothing was begun
    with pytest.raises(ValueError, match="holds jobs of several benchmarks: budget"):
        Benchmark(systems=("lorenz",), methods=("ekf-untuned",), out=out, workers=Workers(1)).run(quiet())


def test_a_method_that_was_changed_is_not_taken_for_the_old_one(toy, tiny, tmp_path):
    name, _ = toy
    script, out = Path(name.rpartition(":")[0]), tmp_path / "out"
    Benchmark(systems=("lorenz",), methods=(name,), out=out, workers=Workers(1)).run(quiet())
    changed = script.with_name("changed.py")
    changed.write_text(
        script.read_text().replace("self.mean, (len(y0)", "2 * self.mean, (len(y0)").replace("x.mean", "x.max")
    )
    with pytest.raises(ValueError, match="another benchmark: code"):
        Benchmark(systems=("lorenz",), methods=(f"{changed}:Constant",), out=out, workers=Workers(1)).run(quiet())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"systems": ("lorentz",)}, "unknown system 'lorentz'"),
        ({"methods": ("kalman",)}, "unknown method 'kalman'"),
        ({"methods": ()}, "at least one"),
        ({"workers": Workers(0)}, "at least one worker"),
        ({"workers": Workers(address="tcp://nowhere:8786")}, "add --backend dask"),
        ({"workers": Workers(backend="dask")}, "needs the --address of its cluster, as in tcp"),
        ({"report": True}, "does not exist; run the benchmark first"),
        ({"measurement_noise": (-0.1,)}, "measurement_noise must be a finite number, not negative, got -0.1"),
        ({"measurement_noise": (math.inf,)}, "measurement_noise"),
        ({"seed": -1}, "seed = -1 must be a whole number from 0"),
        ({"seed": 2**32}, "seed = 4294967296 must be"),
        ({"methods": ("ekf", "ekf")}, "twice"),
        ({"methods": ("ekf", "examples.research.methods.kalman:EKF")}, "twice"),
    ],
)
def test_impossible_benchmarks(wrong, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Benchmark(**{"out": tmp_path / "out", "workers": Workers(1), **wrong}).run(quiet())
    assert not (tmp_path / "out").exists()


def test_worker_processes_do_what_one_process_does(toy, tmp_path):
    name, _ = toy
    jobs = {
        workers: [
            Job(system, name, tmp_path / str(workers) / system, TINY, SHORT, None, SHORT)
            for system in ("lorenz", "van_der_pol")
        ]
        for workers in (1, 2)
    }
    for workers, mine in jobs.items():
        assert [failure for _, failure in run_all(mine, workers)] == [None, None]
    for alone, together in zip(*jobs.values(), strict=True):
        assert (alone.folder / "errors.csv").read_bytes() == (together.folder / "errors.csv").read_bytes()


def test_every_method_at_toy_size(tiny, tmp_path):
    out = tmp_path / "out"
    Benchmark(quick=True, systems=("reverse_duffing",), out=out, workers=Workers(1)).run(quiet())
    methods = pd.read_csv(out / "methods.csv")
    assert set(methods.method) == set(METHODS)
    results = pd.read_csv(out / "results.csv")
    assert np.isfinite(results.smape).all()
    assert (out / "heatmap.png").stat().st_size > 10_000


def test_summary_by_hand():
    frame = pd.DataFrame({"smape": [1.0, 2.0, 3.0, 4.0, np.nan], "escaped": [0, 0, 0, 0, 1]})
    frame = frame.assign(system="lorenz", method="ekf", starts="X", noise=0.0)
    (row,) = summarise(frame, "smape").itertuples()
    assert (row.n, row.median, row.half_iqr) == (4, 2.5, 0.75)
    assert 1.0 <= row.low < 2.5 < row.high <= 4.0


def test_infinite_values_have_a_median_and_a_sign():
    frame = pd.DataFrame({"settling": [1.0, 2.0, math.inf, math.inf, math.inf], "escaped": 0})
    frame = frame.assign(system="lorenz", method="ekf", starts="X", noise=0.0)
    (row,) = summarise(frame, "settling").itertuples()
    assert [_number(value) for value in (row.median, row.half_iqr, 1.2345, 1e-5, 0.0)] == [
        "∞",
        "∞",
        "1.23",
        "<0.001",
        "0",
    ]


def test_report_alone_gives_the_same_table_and_figure(toy, tiny, tmp_path):
    name, _ = toy
    out = tmp_path / "out"
    Benchmark(systems=("lorenz",), methods=(name,), out=out, workers=Workers(1)).run(quiet())
    before = {file: (out / file).read_bytes() for file in ("table.md", "heatmap.png")}
    for file in before:
        (out / file).unlink()
    Benchmark(report=True, out=out).run(quiet())
    assert {file: (out / file).read_bytes() for file in before} == before


def rows_of(page, title):
    """The first table under a title of a Markdown page: the header, then rows of cells by their first one."""
    lines = page.split(f"\n## {title}\n")[1].split("\n## ")[0].splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
    return cells[0][1:], {first: rest for first, *rest in cells[2:]}


@pytest.mark.parametrize("name", ["benchmark", pytest.param("ablation", marks=pytest.mark.slow)])
def test_committed_results_give_the_committed_table_and_figure(name, tmp_path):
    for file in ("results.csv", "methods.csv"):
        shutil.copy(RESULTS / name / file, tmp_path)
    Benchmark(report=True, out=tmp_path).run(quiet())
    page = (tmp_path / "table.md").read_text()
    assert page == (RESULTS / name / "table.md").read_text()
    drawn, committed = (imread(folder / "heatmap.png") for folder in (tmp_path, RESULTS / name))
    assert drawn.shape == committed.shape

    figure = heatmap(*(pd.read_csv(tmp_path / file) for file in ("results.csv", "methods.csv")), note="What it is")
    np.testing.assert_allclose(figure.get_size_inches() * 110, [drawn.shape[1], drawn.shape[0]], atol=1)
    *panels, colorbar = figure.axes
    titles = [
        f"starts in {starts}, noise {noise}" for starts in ("X", "1.5X \\ X", "2X \\ X") for noise in ("0", "0.5")
    ]
    assert [ax.get_title() for ax in panels] == titles
    for ax in panels:
        systems, rows = rows_of(page, f"SMAPE in %, all steps, {ax.get_title()}")
        assert [text.get_text() for text in panels[0].get_yticklabels()] == list(rows)
        assert [text.get_text().replace("\n", " ") for text in panels[-1].get_xticklabels()] == systems
        written = {text.get_position(): text.get_text() for text in ax.texts}
        assert len(written) == len(rows) * len(systems)
        (image,) = ax.images
        for i, row in enumerate(rows.values()):
            for j, cell in enumerate(row):
                expected = [float(number.strip("<")) for number in cell.split(" [")[0].split(" ± ")]
                numbers = [float(number) for number in written[j, i].split(" ± ")]
                np.testing.assert_allclose(numbers, expected, rtol=0.06, atol=0.0051)  # of two and of three digits
                assert image.get_array()[i, j] == pytest.approx(expected[0], rel=0.01, abs=0.001)
    words = {text.get_text() for text in figure.findobj(Text)}
    assert {"What it is", "SMAPE in %, all steps"} <= words
    assert colorbar.get_xlabel() == "SMAPE in %, all steps"


def test_drawing_leaves_the_users_matplotlib_alone(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)  # to import it is an error

    def use(*_, **__):
        raise AssertionError("a backend was chosen")

    monkeypatch.setattr(matplotlib, "use", use)
    results, methods = (pd.read_csv(RESULTS / "ablation" / file) for file in ("results.csv", "methods.csv"))
    few = results.groupby(["system", "method", "starts", "noise"]).head(2)
    assert len(heatmap(few, methods, note="").axes) == 7


@pytest.mark.slow
def test_a_report_says_which_observers_are_missing(tmp_path):
    one = pd.read_csv(RESULTS / "benchmark" / "methods.csv").iloc[:1]
    every = [one.assign(system=system, method=method) for system in SYSTEMS for method in METHODS]
    methods = pd.concat(every)
    missing = (methods.method.isin(["gru", "node"]) & (methods.system == "lorenz")) | (methods.method == "dmf")
    methods[~missing].to_csv(tmp_path / "methods.csv", index=False)
    shutil.copy(RESULTS / "benchmark" / "results.csv", tmp_path)
    Benchmark(report=True, out=tmp_path).run(quiet())
    page = (tmp_path / "table.md").read_text()
    there = f"Partial: {len(every) - 6} of {len(every)} observers."
    assert f"{there} Missing: dmf; node on lorenz; gru on lorenz.\n" in page


def test_new_rows_stand_beside_those_of_an_earlier_run(toy, tiny, tmp_path):
    """As they were, digit by digit; what an observer's new job found takes the place of its old rows."""
    name, trainings = toy
    earlier, out = tmp_path / "earlier", tmp_path / "out"
    Benchmark(systems=("lorenz",), methods=("ekf-untuned",), out=earlier, workers=Workers(1)).run(quiet())
    for file in ("results.csv", "methods.csv"):
        header, *rows = (earlier / file).read_text().splitlines(True)
        both = [row.replace("lorenz", system) for system in ("rossler", "van_der_pol") for row in rows]
        (earlier / file).write_text("".join([header, *both]))
    Benchmark(systems=("rossler",), methods=("ekf-untuned", name), out=out, beside=earlier, workers=Workers(1)).run(
        quiet()
    )
    methods, results = (pd.read_csv(out / file) for file in ("methods.csv", "results.csv"))
    expected = [("van_der_pol", "ekf-untuned"), ("rossler", "ekf-untuned"), ("rossler", "constant")]
    assert list(zip(methods.system, methods.method)) == expected
    assert list(dict.fromkeys(zip(results.system, results.method))) == expected
    old, new = ((folder / "results.csv").read_text().splitlines() for folder in (earlier, out))
    kept = [line for line in old if line.startswith("van_der_pol")]
    assert new[1 : 1 + len(kept)] == kept
    assert not set(new[1:]) & {line for line in old if line.startswith("rossler")}
    assert set(trainings.read_text().split()) == {"rossler", "0.0", "1.0", "2.0"}
    with pytest.raises(ValueError, match=r"earlier.methods.csv: it is of another benchmark: budget tiny, seed 0 there"):
        collect(_of_seed_one(out), earlier)
    with pytest.raises(ValueError, match=r"results.csv does not exist; run the benchmark first"):
        Benchmark(systems=("lorenz",), methods=(name,), out=out, beside=tmp_path, workers=Workers(1)).run(quiet())


def _of_seed_one(out):
    for path in out.glob("jobs/*/*/job.json"):
        job = json.loads(path.read_text())
        job["protocol"]["seed"] = 1
        path.write_text(json.dumps(job))
    return out


def test_levels_of_noise(toy, tiny, tmp_path):
    name, _ = toy
    chosen = ["--systems", "lorenz", "--methods", name, "--measurement-noise", "0.25", "1"]
    main(["benchmark", *chosen, "--jobs", "1", "--out", str(tmp_path)])
    assert set(pd.read_csv(tmp_path / "results.csv").noise) == {0.25, 1.0}


SLOW = """
from linear_system import Oscillator


class Slow(Oscillator):
    name, dt = "slow", 0.1


class Two(Slow):
    name = "two"
    measurement_noise = (0.1, 0.3)

    def h(self, x):
        return x[0], x[1]
"""


def test_systems_of_ones_own_have_times_and_noise_of_their_own(tmp_path, monkeypatch):
    """Beside one that ships, in one folder."""
    script = tmp_path / "slow.py"
    script.write_text(SLOW)
    monkeypatch.setattr(sizes, "QUICK_PROTOCOL", replace(SHORT, duration=1.0))
    monkeypatch.setattr(examples.research.benchmark.jobs, "step_time", lambda *_, **__: 1.0)
    out = tmp_path / "out"
    systems = ("van_der_pol", f"{script}:Slow", f"{script}:Two")
    Benchmark(quick=True, systems=systems, methods=("ekf",), out=out, workers=Workers(1)).run(quiet())
    jobs = [json.loads((out / "jobs" / name / "ekf" / "job.json").read_text()) for name in ("van_der_pol", "slow")]
    assert [job["budget"]["dt"] for job in jobs] == [0.01, 0.1]
    assert [job["budget"]["duration"] for job in jobs] == [20.0, 200.0]
    assert [job["protocol"]["duration"] for job in jobs] == [1.0, 10.0]
    assert [job["validation"]["duration"] for job in jobs] == [20.0, 200.0]
    results = pd.read_csv(out / "results.csv")
    levels = results.groupby("system").noise.unique().map(list).to_dict()
    assert levels == {"van_der_pol": ["0.0", "0.5"], "slow": ["0.0", "0.1"], "two": ["0.0", "0.1, 0.3"]}
    page = (out / "table.md").read_text()
    cells = [rows_of(page, f"SMAPE in %, all steps, starts in X, noise {level}")[1] for level in ("0.1, 0.3", "0.5")]
    assert [[cell == "–" for cell in one["EKF"]] for one in cells] == [[True, True, False], [False, True, True]]
    shown = heatmap(results, pd.read_csv(out / "methods.csv"), note="")
    assert [ax.get_title()[-3:] for ax in shown.axes[:4]] == ["e 0", "0.1", "0.3", "0.5"]


def test_results_lie_under_runs(toy, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Benchmark(systems=("lorenz",), methods=(toy[0],), workers=Workers(1)).run(quiet()) == Path(
        "runs/benchmark/cpu"
    )
    assert (tmp_path / "runs" / "benchmark" / "cpu" / "table.md").exists()


def test_run_is_causal():
    y = np.random.default_rng(0).normal(size=(50, 2, 1))
    method = get_method("ekf")
    arrays = {"diffusion": np.array([0.01])}
    whole = run(method.observer(arrays, get_system("lorenz"), 0.01, 0.5), y)
    part = run(method.observer(arrays, get_system("lorenz"), 0.01, 0.5), y[:20])
    np.testing.assert_array_equal(whole[:20], part)
