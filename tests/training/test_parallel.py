"""Jobs in worker processes of this machine: failures, interruptions, and processes that are killed."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from busy_jobs import Busy, alive, until, work

from training.parallel import TRIES, engine

HELPERS = Path(__file__).parents[1] / "helpers"
needs_proc = pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")


def told(jobs, workers=2, **options):
    with engine(workers, **options) as here:
        ended = list(here.run(work, jobs))
    assert sorted(job.name for job, *_ in ended) == sorted(job.name for job in jobs)
    assert ended[-1][2] == []
    return {job.name: failure for job, failure, _ in ended if failure}


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_is_run_and_failures_are_told(workers, tmp_path):
    jobs = [Busy("a", tmp_path), Busy("b", tmp_path, -1.0), Busy("c", tmp_path, 0.01), Busy("d", tmp_path, 0.02)]
    assert told(jobs, workers) == {"b": "nobody sleeps backward"}
    processes = {number for job in jobs for number in job.processes}
    assert len(processes) <= workers
    assert (processes == {os.getpid()}) == (workers == 1)


def test_jobs_are_begun_in_order_and_those_that_run_are_named(tmp_path):
    jobs = [Busy("long", tmp_path, 2.0), *(Busy(name, tmp_path) for name in "abc")]
    with engine(2) as here:
        running = [running for *_, running in here.run(work, jobs)]
    assert running == [["long", "b"], ["long", "c"], ["long"], []]


def threads(job):
    job.path.write_text(" ".join(os.environ.get(f"{name}_NUM_THREADS", "") for name in ("OMP", "OPENBLAS", "MKL")))


def test_a_worker_has_one_thread(monkeypatch, tmp_path):
    for name in ("OMP", "OPENBLAS", "MKL"):
        monkeypatch.delenv(f"{name}_NUM_THREADS", raising=False)
    jobs = [Busy(name, tmp_path) for name in "ab"]
    with engine(2) as here:
        assert [failure for _, failure, _ in here.run(threads, jobs)] == [None, None]
    assert [job.path.read_text() for job in jobs] == ["1 1 1"] * 2


class UnsendableError(Exception):
    def __init__(self, lock):
        super().__init__(f"with {lock}")


class UnspeakableError(Exception):
    def __str__(self):
        raise RuntimeError("no text")


ERRORS = {
    "odd": UnsendableError("a lock"),
    "silent": ValueError(),
    "unspeakable": UnspeakableError(),
    "leaving": SystemExit("enough"),
    "leaving quietly": SystemExit(),
}


def fail(job):
    raise ERRORS[job.name]


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_that_cannot_be_sent_or_told_and_jobs_that_leave(workers, tmp_path):
    with engine(workers) as here:
        failures = {job.name: failure for job, failure, _ in here.run(fail, [Busy(name, tmp_path) for name in ERRORS])}
    assert failures == {
        "odd": "with a lock",
        "silent": "ValueError",
        "unspeakable": "UnspeakableError",
        "leaving": "left with sys.exit('enough')",
        "leaving quietly": "left with sys.exit(None)",
    }


@needs_proc
def test_what_a_dead_worker_was_at_is_begun_again(tmp_path):
    jobs = [Busy("victim", tmp_path, kills=1), *(Busy(name, tmp_path) for name in "abc")]
    assert told(jobs) == {}
    assert len(jobs[0].processes) == 2


@needs_proc
def test_a_job_that_kills_its_workers_does_not_stop_the_others(tmp_path):
    jobs = [Busy("first", tmp_path), Busy("killer", tmp_path, kills=100), *(Busy(name, tmp_path) for name in "abc")]
    failures = told(jobs)
    assert "killer" in failures
    assert f"was lost {TRIES} times" in failures["killer"]
    assert len(jobs[1].processes) == TRIES
    assert len(failures) <= 2  # one may have been beside it


@needs_proc
def test_the_last_job_that_kills_its_worker_does_not_end_this_process(tmp_path):
    assert "killer" in told([Busy("a", tmp_path), Busy("killer", tmp_path, kills=100)])


@needs_proc
def test_an_interruption_ends_the_workers_and_nobody_else(tmp_path):
    unrelated = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600.0,))
    unrelated.start()
    try:
        mine = [Busy("first", tmp_path, 600.0), Busy("second", tmp_path, 600.0)]
        with engine(2) as here:
            runs = here.run(work, [Busy("short", tmp_path), *mine])
            next(runs)
            until(lambda: mine[0].processes)
            with pytest.raises(KeyboardInterrupt):
                runs.throw(KeyboardInterrupt)
        workers = [number for job in mine for number in job.processes]
        assert not any(map(alive, workers))
        assert unrelated.is_alive()
    finally:
        unrelated.kill()
        unrelated.join()


PARENT = """
import signal
import sys
from pathlib import Path

from busy_jobs import Busy, work
from training.parallel import engine

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore it
    with engine(2) as here:
        list(here.run(work, [Busy(name, Path(sys.argv[1]), 600.0) for name in "ab"]))
"""


@needs_proc
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_workers_do_not_outlive_their_parent(how, tmp_path):
    script, jobs = tmp_path / "parent.py", [Busy(name, tmp_path, 600.0) for name in "ab"]
    script.write_text(PARENT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HELPERS), *sys.path])}
    parent = subprocess.Popen(
        [sys.executable, script, tmp_path], env=environment, stderr=subprocess.PIPE, start_new_session=True, text=True
    )
    try:
        until(lambda: all(job.processes for job in jobs))
        os.killpg(parent.pid, how) if how == signal.SIGINT else parent.send_signal(how)  # Ctrl-C reaches all of them
        _, said = parent.communicate(timeout=120)
    finally:
        parent.kill()
    workers = [number for job in jobs for number in job.processes]
    until(lambda: not any(map(alive, workers)))
    if how == signal.SIGINT:
        assert said.count("Traceback") == 1


@pytest.mark.parametrize(("options", "message"), [
    ({"workers": 0}, "jobs = 0 at a time: give at least one"),
    ({"address": "tcp://nowhere:8786"}, "add --backend dask or --backend ray"),
    ({"backend": "dask"}, "--backend dask needs the --address of its cluster, as in tcp://HOST:8786"),
    ({"backend": "ray"}, "--backend ray needs the --address of its cluster, as in auto, or HOST:6379"),
])  # fmt: skip
def test_engines_that_cannot_be(options, message):
    with pytest.raises(ValueError, match=message), engine(**options):
        raise AssertionError
