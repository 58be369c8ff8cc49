"""Resumable jobs: a pool of worker processes, a lock on each folder, and what identifies the results in it."""

import hashlib
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from filelock import FileLock, Timeout

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import System
from observers.storage import clear_unfinished, write


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
    """Run jobs in worker processes, whatever goes wrong in one of them.

    An interruption ends the workers, and so does the end of this process, even if it is killed.

    Parameters
    ----------
    run : callable
        What to do with a job; a function of a module, so that other processes find it.
    jobs : sequence of jobs
        They are begun in this order, each in one process.
    workers : int
        Number of processes. With one, the jobs run in this process.

    Yields
    ------
    job
        One that has ended.
    Exception or None
        What went wrong in it.
    list of str
        Names of the jobs that run now.
    """
    if workers == 1:
        for job in jobs:
            yield job, _failure(lambda job=job: run(job)), []  # type: ignore[misc]
        return
    context = multiprocessing.get_context("spawn")
    lifeline, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare, initargs=(lifeline,))
    todo, running = list(jobs), dict[Future[None], Job]()
    with lifeline, held, pool:
        try:
            while todo or running:
                while todo and len(running) < workers:  # no more, so that none begins after an interruption
                    job = todo.pop(0)
                    running[pool.submit(run, job)] = job
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    job = running.pop(future)
                    active = [*running.values(), *todo[: len(finished)]]
                    yield job, _failure(future.result), [job.name for job in active]
        except BaseException:
            held.close()
            raise


def _prepare(lifeline: Connection) -> None:
    """Leave interruptions to the parent, and end when it lets go of its end of the pipe, or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        try:
            lifeline.poll(None)  # nothing is ever sent
        finally:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _failure(call: Callable[[], None]) -> Exception | None:
    try:
        call()
    except Exception as error:  # whatever one job does wrong, the others go on
        return error
    return None


def describe(system: System) -> dict[str, Any]:
    """What identifies a system, its equations included: they are sampled at points of the training box.

    Parameters
    ----------
    system : System
        Any system.

    Returns
    -------
    dict
        To be compared with another after a way through JSON, which makes lists of tuples.
    """
    rng = np.random.default_rng(0)
    x = system.draw_starts(rng, 20)
    if system.discrete:
        u = rng.uniform(-1, 1, (system.nu, 20)) * np.array(system.u_max)[:, None]
        moved = components(system.step, x.T, u)
    else:
        moved = [*components(system.f, x.T), *(entry for row in input_matrix(system, x.T) for entry in row)]
    rows = [*moved, *system.output(x).T]
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
    """Refuse to work in a folder that holds something else.

    Parameters
    ----------
    path : Path
        JSON file that says what its folder holds; without it, anything may be written there.
    described : mapping
        What the folder is wanted for; anything that JSON can hold.
    what : str
        It holds otherwise, for the message, such as "results of another benchmark".

    Raises
    ------
    ValueError
        If the file is damaged or says something else; every difference is named.
    """
    if not path.exists():
        return
    here = _as_json(described)
    try:
        there = json.loads(path.read_text())
        changed = [name for name in sorted({*there, *here}) if there.get(name) != here.get(name)]
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged, remove it if nothing in its folder is worth keeping: {error}") from None
    if changed:
        differences = "; ".join(f"{name} = {there.get(name)} there, {here.get(name)} here" for name in changed)
        raise ValueError(f"{path.parent} holds {what}: {differences}. Take another --out, or remove it")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from working in a folder, and clear away what killed ones have left half-written.

    Parameters
    ----------
    folder : Path
        Made if missing.

    Raises
    ------
    ValueError
        If another process is at work there already.
    OSError
        If the folder cannot be made or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise ValueError(f"another process is at work in {folder}") from None
    try:
        clear_unfinished(folder)
        yield
    finally:
        lock.release()


@contextmanager
def claimed_job(folder: Path, described: Mapping[str, Any], what: str) -> Iterator[None]:
    """Lock a job's folder and write what identifies the job in job.json.

    Parameters
    ----------
    folder : Path
        Made if missing.
    described : mapping
        What makes the job's results what they are; anything that JSON can hold.
    what : str
        The folder holds otherwise, for the message, such as "results of another benchmark".

    Raises
    ------
    ValueError
        If the folder holds another job, or another process is at work there.
    """
    path = folder / "job.json"
    with locked(folder):
        check_identity(path, described, what)
        write(path, json.dumps(_as_json(described), indent=2) + "\n")
        yield


@contextmanager
def claimed_run(folder: Path, described: Mapping[str, Any], resume: bool) -> Iterator[None]:
    """Lock a training run's folder and write what identifies the run in config.json.

    A folder without checkpoints is free for any run.

    Parameters
    ----------
    folder : Path
        Made if missing.
    described : mapping
        The run; anything that JSON can hold.
    resume : bool
        Go on with the run whose checkpoints lie there.

    Raises
    ------
    ValueError
        If checkpoints would be spoiled, or another process is at work there.
    """
    with locked(folder):
        if not resume:
            refuse_checkpoints(folder)
        elif _has_checkpoints(folder):
            check_identity(folder / "config.json", described, "a run of another configuration")
        write(folder / "config.json", json.dumps(_as_json(described), indent=2) + "\n")
        yield


def refuse_checkpoints(folder: Path) -> None:
    """Raise ValueError if a folder holds the checkpoints of a run."""
    if _has_checkpoints(folder):
        raise ValueError(
            f"{folder} holds the checkpoints of a run: go on with it (resume=True, --resume), remove it, or take "
            "another folder (--out)"
        )


def _has_checkpoints(folder: Path) -> bool:
    return any(folder.glob("[!.]*.checkpoint.*"))


def _as_json(described: Mapping[str, Any]) -> dict[str, Any]:
    """As it will be read from a file: lists in place of tuples."""
    return dict(json.loads(json.dumps(described)))
