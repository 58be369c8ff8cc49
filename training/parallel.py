"""One engine for independent jobs, joblib: worker processes of this machine, or a cluster of Dask's or Ray's."""

import multiprocessing
import os
import signal
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor

from training.clusters import CLUSTERS

Backend = Literal["loky", "dask", "ray"]

WORKERS = 2  # of this machine, unless told otherwise
TRIES = 3  # of a job whose worker dies


class Named(Protocol):
    """What a job must have."""

    @property
    def name(self) -> str:
        """For people."""
        ...


Job = TypeVar("Job", bound=Named)


@dataclass(frozen=True)
class Engine:
    """What runs jobs."""

    workers: int
    settings: Mapping[str, Any]
    around: Callable[[], AbstractContextManager[None]] = nullcontext

    def run(self, run: Callable[[Job], None], jobs: Sequence[Job]) -> Iterator[tuple[Job, str | None, list[str]]]:
        """Run jobs, whatever goes wrong in one of them.

        Where a worker dies, what it and those beside it were at is run again, ``TRIES`` times in all. An interruption
        ends the workers, and so does the end of this process, even if it is killed.
        """
        todo, lost = dict(enumerate(jobs)), Counter[int]()
        workers = min(self.workers, len(todo))
        while todo:
            with parallel_config(**self.settings):
                parallel = Parallel(
                    n_jobs=workers,
                    return_as="generator_unordered",
                    batch_size=1,
                    pre_dispatch=workers,  # no more, so that none begins after an interruption
                )
            calls = [delayed(_attempt)(run, job, index, self.around) for index, job in todo.items()]
            ended = parallel(calls)
            try:
                for index, failure in ended:
                    yield todo.pop(index), failure, self._running(todo)
            except Exception as error:  # not a job's, which comes as a result
                for index in list(todo)[:workers]:
                    lost[index] += 1
                    if lost[index] == TRIES:
                        yield todo.pop(index), f"was lost {TRIES} times with its worker: {error}", self._running(todo)
            except BaseException:
                with warnings.catch_warnings(action="ignore"):  # that not all jobs have run
                    ended.close()
                raise

    def _running(self, todo: Mapping[int, Named]) -> list[str]:
        """Names of those that run: jobs are begun in their order."""
        return [job.name for job in list(todo.values())[: self.workers]]


def _attempt(
    run: Callable[[Job], None], job: Job, index: int, around: Callable[[], AbstractContextManager[None]]
) -> tuple[int, str | None]:
    """Run a job, where it runs; whatever it does wrong, the others go on."""
    try:
        with around():
            run(job)
    except (Exception, SystemExit) as error:  # as text: not every error finds its way from process to process
        return index, _text(error)
    return index, None


def _text(error: BaseException) -> str:
    """Say what an error says; one that says nothing, or cannot, by its name."""
    if isinstance(error, SystemExit):
        return f"left with sys.exit({error.code!r})"
    try:
        return str(error) or type(error).__name__
    except Exception:
        return type(error).__name__


@contextmanager
def engine(workers: int | None = None, *, backend: Backend = "loky", address: str | None = None) -> Iterator[Engine]:
    """Find workers for jobs, for as long as the context lasts."""
    if workers is not None and workers < 1:
        raise ValueError(f"jobs = {workers} at a time: give at least one worker process")
    if backend == "loky":
        if address is not None:
            raise ValueError(f"--address {address} is a cluster's: add --backend dask or --backend ray")
        with _this_machine(workers or WORKERS) as found:
            yield found
        return
    if address is None:
        example = {"dask": "tcp://HOST:8786", "ray": "auto, or HOST:6379"}[backend]
        raise ValueError(f"--backend {backend} needs the --address of its cluster, as in {example}")
    with CLUSTERS[backend](address) as (cores, futures, around):
        yield Engine(min(workers or cores, cores), {"backend": futures}, partial(around, Path.cwd()))


@contextmanager
def _this_machine(workers: int) -> Iterator[Engine]:
    lifeline, held = multiprocessing.Pipe(duplex=False)
    with lifeline, held:
        settings = {"inner_max_num_threads": 1, "initializer": _prepare, "initargs": (lifeline,)}
        try:
            yield Engine(workers, {"backend": "loky", **settings})
        finally:
            if workers > 1:  # it would keep them for the next jobs, with all that they have imported
                get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)


def _prepare(lifeline: Connection) -> None:
    """Leave interruptions to the parent, and end when its end of the pipe is closed: by a kill, too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        try:
            lifeline.poll(None)  # nothing is ever sent
        finally:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
