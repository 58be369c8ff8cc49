"""Jobs for worker processes: a job sleeps, fails or kills its process, and records the processes that ran it."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

WAIT = 120.0  # seconds: processes with many imports start slowly on a busy machine
# Exceptions by the names of the jobs that raise them.
ERRORS = {"bad": ValueError("this one is bad"), "silent": ValueError(), "leaving": SystemExit("enough")}


@dataclass(frozen=True)
class Busy:
    """A job that kills its process in its first `kills` runs, and then sleeps."""

    name: str
    folder: Path
    seconds: float = 0.0
    kills: int = 0

    @property
    def processes(self):
        """Ids of the processes that have run this job."""
        path = self.folder / self.name
        return [int(line) for line in path.read_text().split()] if path.exists() else []


def work(job):
    """Run a job; worker processes import this function."""
    with (job.folder / job.name).open("a") as file:
        file.write(f"{os.getpid()}\n")
    if job.name in ERRORS:
        raise ERRORS[job.name]
    if len(job.processes) <= job.kills:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(job.seconds)


def until(condition):
    """Wait until the condition holds, for WAIT seconds at most."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < WAIT
        time.sleep(0.05)


def alive(process):
    """Whether a process, given by its id, runs and is no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
