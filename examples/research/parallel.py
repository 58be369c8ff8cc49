"""Independent jobs in worker processes of this machine."""

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor

TRIES = 3  # attempts at a job whose worker dies

Job = TypeVar("Job")


@dataclass(frozen=True)
class Engine:
    """Runs jobs in a number of worker processes."""

    workers: int

    def run(self, run: Callable[[Job], None], jobs: Sequence[Job]) -> Iterator[tuple[Job, str | None]]:
        """Yield each job when it ends, with the text of its error or None; jobs start in the given order."""
        todo, lost = dict(enumerate(jobs)), Counter[int]()
        workers = min(self.workers, len(todo))
        attempt = delayed(partial(_attempt, run, Path.cwd()))
        while todo:
            # Each worker has one job at a time, so the job of a dead worker is among the first ones that are not done.
            # These suspects then run one by one, because joblib may also drop the results of jobs beside a dead worker.
            suspects = [index for index in todo if lost[index]]
            handed = 1 if suspects else workers
            begun = suspects[:1] or list(todo)
            # With one worker, joblib would run jobs in this process, and a job could kill it.
            parallel = Parallel(max(2, workers), return_as="generator_unordered", batch_size=1, pre_dispatch=handed)
            try:
                for index, failure in parallel([attempt(index, todo[index]) for index in begun]):
                    yield todo.pop(index), failure
            except Exception as error:  # a worker died; errors of jobs are returned as text
                for index in [index for index in begun if index in todo][:handed]:
                    lost[index] += 1
                    if lost[index] == TRIES:
                        yield todo.pop(index), f"was lost {TRIES} times with its worker: {error}"


def _attempt(run: Callable[[Job], None], folder: Path, index: int, job: Job) -> tuple[int, str | None]:
    """Run a job in a folder; returns its error as text, because not every exception can be pickled."""
    try:
        with chdir(folder):
            run(job)
    except SystemExit as error:
        return index, f"left with sys.exit({error.code!r})"
    except Exception as error:
        return index, str(error) or type(error).__name__
    return index, None


@contextmanager
def engine(workers: int) -> Iterator[Engine]:
    """Yield an engine whose worker processes end with the context."""
    if workers < 1:
        raise ValueError(f"jobs = {workers}: give at least one worker process")
    with parallel_config("loky", inner_max_num_threads=1, initializer=_end_with, initargs=(os.getpid(),)):
        try:
            yield Engine(workers)
        finally:
            get_reusable_executor(reuse=True).shutdown(kill_workers=True)


def _end_with(parent: int) -> None:
    """End this worker soon after its parent is killed; loky alone would let it finish its job."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
