"""Independent jobs in worker processes."""

import multiprocessing
import os
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
    """Run jobs in worker processes; yields each with its failure, if any, and the names of those that run next.

    ``run`` is a function of a module. With one worker, the jobs run in this process.
    """
    if workers == 1:
        for job in jobs:
            yield job, _failure(lambda job=job: run(job)), []  # type: ignore[misc]
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with, initargs=(os.getpid(),)) as pool:
        futures: dict[Future[None], Job] = {pool.submit(run, job): job for job in jobs}
        try:
            while futures:
                finished, _ = wait(futures, return_when=FIRST_COMPLETED)
                for future in finished:
                    job = futures.pop(future)
                    yield job, _failure(future.result), [job.name for job in list(futures.values())[:workers]]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with(parent: int) -> None:
    """End this process when its parent is gone, even if that was killed."""

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
