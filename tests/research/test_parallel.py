"""Jobs in worker processes and on clusters: failures, interruptions, and processes that are killed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from busy_jobs import Busy, alive, until, work

from examples.research.parallel import TRIES, engine

IMPORTS = {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1] / "helpers"), *sys.path])}
FAILURES = {"bad": "this one is bad", "silent": "ValueError", "leaving": "left with sys.exit('enough')"}
needs_proc = pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")


def run(jobs, workers=2, **options):
    with engine(workers, **options) as here:
        return {job.name: failure for job, failure in here.run(work, jobs)}


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failure_does_not_stop_the_others(workers, tmp_path):
    jobs = [Busy(name, tmp_path) for name in ("a", *FAILURES, "z")]
    assert run(jobs, workers) == {"a": None, **FAILURES, "z": None}
    assert os.getpid() not in {number for job in jobs for number in job.processes}


def threads(job):
    (job.folder / job.name).write_text(os.environ["OPENBLAS_NUM_THREADS"])


def test_a_worker_has_one_thread(monkeypatch, tmp_path):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with engine(2) as here:
        assert [failure for _, failure in here.run(threads, [Busy(name, tmp_path) for name in "ab"])] == [None, None]
    assert (tmp_path / "a").read_text() == "1"


@needs_proc
def test_what_a_dead_worker_was_at_is_begun_again(tmp_path):
    jobs = [Busy("victim", tmp_path, 2.0, kills=1), *(Busy(name, tmp_path) for name in "abc")]
    assert run(jobs) == dict.fromkeys(("victim", "a", "b", "c"))
    assert len(jobs[0].processes) == 2


@needs_proc
def test_a_job_that_kills_its_workers_stops_neither_the_others_nor_this_process(tmp_path):
    jobs = [Busy("a", tmp_path, 1.0), Busy("killer", tmp_path, kills=100), *(Busy(name, tmp_path) for name in "bc")]
    failures = run(jobs)
    assert f"was lost {TRIES} times" in failures.pop("killer")
    assert failures == dict.fromkeys("abc")
    assert len(jobs[1].processes) in (TRIES, TRIES + 1)  # a pool that breaks may hand a job out once more
    alone = Busy("alone", tmp_path, kills=100)
    assert "lost" in run([alone], workers=1)["alone"]


PARENT = """
import signal, sys, pathlib, busy_jobs
from examples.research.parallel import engine

signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore it
with engine(2) as here:
    list(here.run(busy_jobs.work, [busy_jobs.Busy(name, pathlib.Path(sys.argv[1]), 600.0) for name in "ab"]))
"""


@needs_proc
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_workers_do_not_outlive_their_parent(how, tmp_path):
    jobs = [Busy(name, tmp_path) for name in "ab"]
    options = {"stderr": subprocess.PIPE, "start_new_session": True, "text": True, "env": {**os.environ, **IMPORTS}}
    parent = subprocess.Popen([sys.executable, "-c", PARENT, tmp_path], **options)
    try:
        until(lambda: all(job.processes for job in jobs))
        os.killpg(parent.pid, how) if how == signal.SIGINT else parent.send_signal(how)  # Ctrl-C reaches all of them
        _, errors = parent.communicate(timeout=120)
    finally:
        parent.kill()
    until(lambda: not any(alive(number) for job in jobs for number in job.processes))
    assert errors.count("Traceback") == (how == signal.SIGINT)


@needs_proc
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # joblib's, of jobs that were cancelled
def test_workers_end_when_the_context_is_left(tmp_path):
    long = Busy("long", tmp_path, 600.0)
    with engine(2) as here:
        ended = here.run(work, [long, Busy("short", tmp_path)])
        assert next(ended)[1] is None
        until(lambda: long.processes)
    assert not alive(long.processes[0])


@pytest.mark.parametrize(("options", "message"), [
    ({"workers": 0}, "jobs = 0 at a time: give at least one"),
    ({"address": "tcp://nowhere:8786"}, "add --backend dask or --backend ray"),
    ({"backend": "dask"}, "--backend dask needs the --address of its cluster, as in tcp://HOST:8786"),
    ({"backend": "ray"}, "--backend ray needs the --address of its cluster, as in auto, or HOST:6379"),
])  # fmt: skip
def test_engines_that_cannot_be(options, message):
    with pytest.raises(ValueError, match=message), engine(**options):
        raise AssertionError


# What the libraries themselves leave open when a cluster ends.
leaky = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@leaky
@pytest.mark.parametrize(("workers", "found"), [(0, "no worker"), (1, r"\{.*: 2\}")])
def test_dask_without_workers_of_one_thread(workers, found):
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": workers, "threads_per_worker": 2, "processes": False, "dashboard_address": ":0"}
    with (
        distributed.LocalCluster(**options) as cluster,
        pytest.raises(ValueError, match=f"of one thread each, dask worker .* --nthreads 1; got {found}"),
        engine(backend="dask", address=cluster.scheduler_address),
    ):
        raise AssertionError


def run_on(backend, address, folder, monkeypatch):
    monkeypatch.chdir(folder)  # of the workers, too
    jobs = [Busy("a", Path()), Busy("bad", Path()), Busy("victim", Path(), kills=1)]
    assert run(jobs, backend=backend, address=address) == {"a": None, "bad": FAILURES["bad"], "victim": None}
    assert os.getpid() not in {number for job in jobs for number in job.processes}


@leaky
@pytest.mark.slow
def test_dask(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        run_on("dask", cluster.scheduler_address, tmp_path, monkeypatch)


@leaky
@pytest.mark.slow
def test_ray(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    for name, value in {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled", **IMPORTS}.items():
        monkeypatch.setenv(name, value)
    run_on("ray", "local", tmp_path, monkeypatch)
