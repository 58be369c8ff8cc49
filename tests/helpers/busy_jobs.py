"""Jobs for worker processes: they sleep, fail, or kill the process that they run in, and count these processes."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

WAIT = 120.0  # seconds, for processes that import much on a busy machine
# By the names of jobs that raise them.
ERRORS = {"bad": ValueError("this one is bad"), "silent": ValueError(), "leaving": SystemExit("enough")}


@dataclass(frozen=True)
class Busy:
    """A job that sleeps, after it has killed its process as often as it is to."""

    name: str
    folder: Path
    seconds: float = 0.0
    kills: int = 0

    @property
    def processes(self):
        """Numbers of the processes that it has run in."""
        path = self.folder / self.name
        return [int(line) for line in path.read_text().split()] if path.exists() else []


def work(job):
    """Do a job."""
    with (job.folder / job.name).open("a") as file:
        file.write(f"{os.getpid()}\n")
    if job.name in ERRORS:
        raise ERRORS[job.name]
    if len(job.processes) <= job.kills:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(job.seconds)


def until(condition):
    """Wait for something."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < WAIT
        time.sleep(0.05)


def alive(process):
    """Whether a process, by its number, runs (and not only waits to be buried)."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
