"""Resumable jobs: a pool of worker processes, a lock on each folder, and what identifies the results in it."""

import hashlib
import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from filelock import FileLock, Timeout

from kkl_gym.system import System
from observers.storage import write


class Named(Protocol):
    """What a job must have."""

    @property
    def name(self) -> str:
        """For people."""
        ...


Job = TypeVar("Job", bound=Named)


def run_all(
    run: Callable[[Job], None], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[Job, Exception | None, list[str]]]:
    """Run jobs in worker processes; yields each with its failure, if any, and the names of those that run now.

    ``run`` is a function of a module. With one worker, the jobs run in this process. An interruption ends the workers.
    """
    if workers == 1:
        for job in jobs:
            yield job, _failure(lambda job=job: run(job)), []  # type: ignore[misc]
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare, initargs=(os.getpid(),))
    todo, running = list(jobs), dict[Future[None], Job]()
    try:
        while todo or running:
            while todo and len(running) < workers:  # no more, so that none begins after an interruption
                job = todo.pop(0)
                running[pool.submit(run, job)] = job
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                job = running.pop(future)
                yield job, _failure(future.result), [job.name for job in (*running.values(), *todo[: len(finished)])]
    except BaseException:
        for process in list((pool._processes or {}).values()):  # its own only, not every child of this process
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare(parent: int) -> None:
    """Leave interruptions to the parent, and end when it is gone, even if that was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _failure(call: Callable[[], None]) -> Exception | None:
    try:
        call()
    except Exception as error:  # whatever one job does wrong, the others go on
        return error
    return None


def describe(system: System) -> dict[str, Any]:
    """What identifies a system, its equations included: they are sampled at points of the training box."""
    x = np.random.default_rng(0).uniform(*system.box(), (20, system.nx))
    rows = [*system.f(x.T), *(entry for row in system.g(x.T) for entry in row), *system.output(x).T]
    equations = np.round([np.broadcast_to(row, 20) for row in rows], 6)  # the same on every machine
    return {
        "system": system.name,
        "parameters": system.parameters,
        "X": system.X,
        "bounds": system.bounds,
        "u_max": system.u_max,
        "equations": hashlib.sha256(json.dumps(equations.tolist()).encode()).hexdigest()[:16],
    }


def check_identity(path: Path, described: Mapping[str, Any], what: str) -> None:
    """Raise ValueError, naming every difference, if a file says that its folder is of something else than described.

    what : the folder holds, for the message.
    """
    if not path.exists():
        return
    try:
        before = json.loads(path.read_text())
        changed = [name for name in sorted({*before, *described}) if before.get(name) != described.get(name)]
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged, remove it if nothing in its folder is worth keeping: {error}") from None
    if changed:
        differences = "; ".join(f"{name} = {before.get(name)} there, {described.get(name)} here" for name in changed)
        raise ValueError(f"{path.parent} holds {what}: {differences}. Take another --out, or remove it")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from working in a folder, which is made; raises ValueError if one does already."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0):
            yield
    except Timeout:
        raise ValueError(f"another process is at work in {folder}") from None


@contextmanager
def claimed_run(folder: Path, described: Mapping[str, Any], resume: bool) -> Iterator[None]:
    """Lock a training run's folder and write what identifies the run, unless another run lies there.

    Raises ValueError if that run would be spoiled, or another process is at work on it.
    """
    described = json.loads(json.dumps(described))
    with locked(folder):
        if any(folder.glob("*.checkpoint.*")):
            if not resume:
                raise ValueError(
                    f"{folder} holds the checkpoints of a run: go on with it (resume=True, --resume), remove it, "
                    "or take another folder (--out)"
                )
            check_identity(folder / "config.json", described, "a run of another configuration")
        write(folder / "config.json", json.dumps(described, indent=2) + "\n")
        yield
