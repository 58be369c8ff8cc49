"""Jobs for worker processes: they sleep, fail, or kill the process that they run in, and say which process that is."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

WAIT = 120.0  # seconds, for processes that import much on a busy machine


@dataclass(frozen=True)
class Busy:
    """A job that sleeps, after it has killed its process as often as it is to."""

    name: str
    folder: Path
    seconds: float = 0.0
    kills: int = 0

    @property
    def path(self):
        """The file in which it counts its processes."""
        return self.folder / self.name

    @property
    def processes(self):
        """Numbers of the processes that it has run in."""
        return [int(line) for line in self.path.read_text().split()] if self.path.exists() else []


def work(job):
    """Do a job."""
    if job.seconds < 0:
        raise ValueError("nobody sleeps backward")
    with job.path.open("a") as file:
        file.write(f"{os.getpid()}\n")
    if len(job.processes) <= job.kills:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(job.seconds)


def solve(job):
    """Write numbers that hang together, so that another order of rounding would show; a bad job fails after it."""
    matrix = np.random.default_rng(len(job.name)).normal(size=(60, 60))
    job.path.write_bytes(np.linalg.solve(matrix, matrix @ matrix).tobytes())
    if job.name == "bad":
        raise ValueError("this one is bad")


def write_here(job):
    """Write a file to the working directory."""
    Path(job.name).write_text("here")


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
