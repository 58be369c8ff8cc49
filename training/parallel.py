"""Independent jobs in worker processes."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from typing import Protocol, TypeVar


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
        for process in multiprocessing.active_children():
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
