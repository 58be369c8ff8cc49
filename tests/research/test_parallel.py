"""Jobs in worker processes: failures, interruptions and killed processes."""

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


def run(jobs, workers=2):
    with engine(workers) as here:
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
def test_the_job_of_a_killed_worker_runs_again(tmp_path):
    jobs = [Busy("victim", tmp_path, 2.0, kills=1), *(Busy(name, tmp_path) for name in "abc")]
    assert run(jobs) == dict.fromkeys(("victim", "a", "b", "c"))
    assert len(jobs[0].processes) == 2


@needs_proc
def test_a_job_that_kills_its_workers_stops_neither_the_others_nor_this_process(tmp_path):
    jobs = [Busy("a", tmp_path, 1.0), Busy("killer", tmp_path, kills=100), *(Busy(name, tmp_path) for name in "bc")]
    failures = run(jobs)
    assert f"was lost {TRIES} times" in failures.pop("killer")
    assert failures == dict.fromkeys("abc")
    assert len(jobs[1].processes) == TRIES
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
        os.killpg(parent.pid, how) if how == signal.SIGINT else parent.send_signal(how)  # Ctrl-C reaches workers too
        _, errors = parent.communicate(timeout=120)
    finally:
        parent.kill()
    until(lambda: not any(alive(number) for job in jobs for number in job.processes))
    assert errors.count("Traceback") == (how == signal.SIGINT)


@needs_proc
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # joblib warns of cancelled jobs
def test_workers_end_when_the_context_is_left(tmp_path):
    long = Busy("long", tmp_path, 600.0)
    with engine(2) as here:
        ended = here.run(work, [long, Busy("short", tmp_path)])
        assert next(ended)[1] is None
        until(lambda: long.processes)
    assert not alive(long.processes[0])


def test_an_engine_needs_a_worker():
    with pytest.raises(ValueError, match="jobs = 0: give at least one"), engine(0):
        raise AssertionError
