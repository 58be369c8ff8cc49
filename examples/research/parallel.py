"""Independent jobs on joblib: worker processes of this machine, or a cluster of Dask's or Ray's."""

import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor

Backend = Literal["loky", "dask", "ray"]

DEFAULT_WORKERS = 2  # processes of this machine
TRIES = 3  # of a job whose worker dies
ADDRESSES = {"dask": "tcp://HOST:8786", "ray": "auto, or HOST:6379"}

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
def engine(workers: int | None = None, *, backend: Backend = "loky", address: str | None = None) -> Iterator[Engine]:
    """Find workers for jobs, for as long as the context lasts."""
    if workers is not None and workers < 1:
        raise ValueError(f"jobs = {workers} at a time: give at least one worker process")
    if backend == "loky":
        if address is not None:
            raise ValueError(f"--address {address} is a cluster's: add --backend dask or --backend ray")
        workers = workers or DEFAULT_WORKERS
        with parallel_config("loky", inner_max_num_threads=1, initializer=_end_with, initargs=(os.getpid(),)):
            try:
                yield Engine(workers)
            finally:
                get_reusable_executor(reuse=True).shutdown(kill_workers=True)
    elif address is None:
        raise ValueError(f"--backend {backend} needs the --address of its cluster, as in {ADDRESSES[backend]}")
    else:
        with _CLUSTERS[backend](address) as cores, parallel_config(backend):
            yield Engine(min(workers or cores, cores))


def _end_with(parent: int) -> None:
    """End this worker soon after its parent, which may be killed: loky's go on to the end of their job."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask(address: str) -> Iterator[int]:
    """Connect to a scheduler of Dask's; gives the number of its workers."""
    from distributed import Client

    with Client(address) as client:
        threads = client.nthreads()
        if set(threads.values()) != {1}:  # a job counts the CPU time of its process
            raise ValueError(
                f"--backend dask needs workers of one thread each, dask worker {address} --nthreads 1; got "
                f"{threads or 'no worker'}"
            )
        yield len(threads)


@contextmanager
def _ray(address: str) -> Iterator[int]:
    """Connect to Ray; gives the number of its cores."""
    import ray
    from ray.util.joblib import register_ray
    from ray.util.joblib.ray_backend import RayBackend

    register_ray()
    # RayBackend inherits False from the pool of multiprocessing; Ray's own pool hands results over as they come.
    RayBackend.supports_return_generator = True
    ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    try:
        yield int(ray.cluster_resources().get("CPU", 1))
    finally:
        ray.shutdown()


_CLUSTERS = {"dask": _dask, "ray": _ray}
