"""Jobs on real clusters of Dask's and Ray's, which run on this machine here: as in worker processes, file for file."""

import os
import sys
from pathlib import Path

import pandas as pd
import pytest
from busy_jobs import Busy, alive, solve, until, work, write_here
from rich.console import Console
from safetensors.numpy import load_file

from examples.research.benchmark.command import Benchmark
from training import clusters
from training.commands.running import Workers
from training.parallel import engine

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
ray = pytest.importorskip("ray")

HELPERS = Path(__file__).parents[1] / "helpers"
needs_proc = pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")
# What the libraries themselves leave open when a cluster ends.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def dask_cluster():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**options) as cluster:
        yield "dask", cluster.scheduler_address


@pytest.fixture(scope="module")
def ray_cluster():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_AUTH_MODE", "disabled")
        patch.setenv("PYTHONPATH", os.pathsep.join([str(HELPERS), *sys.path]))  # of the workers
        ray.init("local", num_cpus=2, include_dashboard=False, object_store_memory=100 * 2**20, log_to_driver=False)
        address = ray.get_runtime_context().gcs_address
        yield "ray", address
        ray.shutdown()


@pytest.fixture(params=["dask", "ray"])
def cluster(request):
    return request.getfixturevalue(f"{request.param}_cluster")


def test_the_same_files_and_the_same_failures_as_in_worker_processes(cluster, tmp_path):
    backend, address = cluster
    written = []
    for options in ({}, {"backend": backend, "address": address}):
        folder = tmp_path / options.get("backend", "loky")
        folder.mkdir()
        with engine(2, **options) as here:
            assert here.workers == 2
            ended = list(here.run(solve, [Busy(name, folder) for name in ("a", "bad", "ccc", "dddd")]))
        assert {job.name: failure for job, failure, _ in ended if failure} == {"bad": "this one is bad"}
        assert ended[-1][2] == []
        written.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert len(written[0]) == 4
    assert written[0] == written[1]


@pytest.mark.slow
def test_a_quick_benchmark_is_the_same_bit_for_bit(dask_cluster, ray_cluster, tmp_path):
    """Results, errors of every trajectory and weights; seconds of training and microseconds of a step are left out."""
    written = []
    for backend, address in (("loky", None), dask_cluster, ray_cluster):
        command = Benchmark(
            quick=True,
            systems=("van_der_pol",),
            methods=("default", "node", "ekf-untuned"),
            out=tmp_path / backend,
            workers=Workers(2, backend, address),
        )
        out = command.run(Console(quiet=True))
        files = {path.relative_to(out): path.read_bytes() for path in [out / "results.csv", *out.rglob("errors.csv")]}
        weights = {
            (path.relative_to(out), name): array.tobytes()
            for path in out.rglob("trained.safetensors")
            for name, array in load_file(path).items()
        }
        costs = pd.read_csv(out / "methods.csv").drop(columns=["train_seconds", "us_batch_1", "us_batch_1000"])
        written.append((files, weights, costs.to_csv()))
    files, weights, _ = written[0]
    assert len(files) == 4
    assert len(weights) > 4
    assert written[0] == written[1]
    assert written[0] == written[2]


def test_paths_are_meant_from_where_the_command_was_begun(cluster, tmp_path, monkeypatch):
    backend, address = cluster
    monkeypatch.chdir(tmp_path)
    with engine(backend=backend, address=address) as here:
        assert [failure for _, failure, _ in here.run(write_here, [Busy(name, Path()) for name in "ab"])] == [None] * 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


@needs_proc
def test_a_single_job_runs_in_the_cluster_and_again_if_its_worker_dies(cluster, tmp_path):
    backend, address = cluster
    job = Busy("a", tmp_path, kills=1)
    with engine(1, backend=backend, address=address) as here:
        assert [failure for _, failure, _ in here.run(work, [job])] == [None]
    assert len(job.processes) == 2
    assert os.getpid() not in job.processes


@needs_proc
def test_an_interruption_ends_the_jobs_and_leaves_the_cluster(cluster, tmp_path):
    backend, address = cluster
    mine = Busy("long", tmp_path, 600.0)
    with engine(2, backend=backend, address=address) as here:
        runs = here.run(work, [Busy("short", tmp_path), mine])
        next(runs)
        until(lambda: mine.processes)
        with pytest.raises(KeyboardInterrupt):
            runs.throw(KeyboardInterrupt)
        until(lambda: not alive(mine.processes[0]))
        assert [failure for _, failure, _ in here.run(work, [Busy("after", tmp_path)])] == [None]


def test_workers_with_several_threads_are_refused():
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": ":0"}
    with (
        distributed.LocalCluster(**options) as cluster,
        pytest.raises(ValueError, match="Dask's workers must have one thread each: start them with --nthreads 1"),
        engine(backend="dask", address=cluster.scheduler_address),
    ):
        raise AssertionError


def test_a_scheduler_without_workers(monkeypatch):
    monkeypatch.setattr(clusters, "PATIENCE", 0.1)
    options = {"n_workers": 0, "processes": False, "dashboard_address": ":0"}
    with (
        distributed.LocalCluster(**options) as cluster,
        pytest.raises(ValueError, match="has no workers: start some, dask worker"),
        engine(backend="dask", address=cluster.scheduler_address),
    ):
        raise AssertionError


def test_nobody_answers(monkeypatch):
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "0.2s"}),
        pytest.raises(OSError, match=r"tcp://127\.0\.0\.1:9"),
        engine(backend="dask", address="tcp://127.0.0.1:9"),
    ):
        raise AssertionError
