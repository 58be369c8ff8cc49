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

TRIES = 3  # of a job whose worker dies

Job = TypeVar("Job")


@dataclass(frozen=True)
class Engine:
    """Runs jobs, as many at a time as it has workers."""

    workers: int

    def run(self, run: Callable[[Job], None], jobs: Sequence[Job]) -> Iterator[tuple[Job, str | None]]:
        """Yield each job when it ends, with the text of its error if it failed; jobs begin in their order."""
        todo, lost = dict(enumerate(jobs)), Counter[int]()
        workers = min(self.workers, len(todo))
        attempt = delayed(partial(_attempt, run, Path.cwd()))
        while todo:
            suspects = {index: job for index, job in todo.items() if lost[index]}
            # As many are handed out as there are workers: a dead worker was at one of the first. Those go one by one.
            handed = 1 if suspects else workers
            # joblib would run a single job in this process, which a job must not be able to kill.
            parallel = Parallel(max(2, workers), return_as="generator_unordered", batch_size=1, pre_dispatch=handed)
            try:
                for index, failure in parallel([attempt(*item) for item in (suspects or todo).items()]):
                    yield todo.pop(index), failure
            except Exception as error:  # a worker died: what a job raises comes as its failure
                for index in [index for index in suspects or todo if index in todo][:handed]:
                    lost[index] += 1
                    if lost[index] == TRIES:
                        yield todo.pop(index), f"was lost {TRIES} times with its worker: {error}"


def _attempt(run: Callable[[Job], None], folder: Path, index: int, job: Job) -> tuple[int, str | None]:
    """Run a job in a folder; its error becomes text, as not every error can be sent to another process."""
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
    """Worker processes for jobs, for as long as the context lasts."""
    if workers < 1:
        raise ValueError(f"jobs = {workers} at a time: give at least one worker process")
    with parallel_config("loky", inner_max_num_threads=1, initializer=_end_with, initargs=(os.getpid(),)):
        try:
            yield Engine(workers)
        finally:
            get_reusable_executor(reuse=True).shutdown(kill_workers=True)


def _end_with(parent: int) -> None:
    """End this worker soon after its parent, which may be killed: loky's go on to the end of their job."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
