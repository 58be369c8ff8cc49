"""Jobs in worker processes."""

import time
from dataclasses import dataclass

import pytest

from training.jobs import run_all


@dataclass(frozen=True)
class Sleep:
    seconds: float

    @property
    def name(self):
        return f"{self.seconds} s"


def sleep(job):
    if job.seconds < 0:
        raise ValueError("nobody sleeps backward")
    time.sleep(job.seconds)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_is_run_and_failures_are_told(workers):
    jobs = [Sleep(0.0), Sleep(-1.0), Sleep(0.01), Sleep(0.02)]
    results = list(run_all(sleep, jobs, workers))
    assert sorted(job.seconds for job, _, _ in results) == [-1.0, 0.0, 0.01, 0.02]
    assert {job.seconds: str(failure) for job, failure, _ in results if failure} == {-1.0: "nobody sleeps backward"}
    assert results[-1][2] == []


def test_an_interruption_ends_the_workers():
    jobs = [Sleep(0.0), Sleep(600.0), Sleep(600.0)]
    runs = run_all(sleep, jobs, 2)
    next(runs)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        runs.throw(KeyboardInterrupt)
    assert time.monotonic() - began < 60.0
