"""Clusters of Dask's and Ray's as backends of joblib.

Both libraries have one, which jobs of minutes cannot use: joblib's for Dask (1.6.0) waits for ever for a job that the
scheduler has given up, and Ray's (2.60) gives the next job to the next worker in turn, whether that is free or not.
"""

import logging
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, chdir, contextmanager
from pathlib import Path
from typing import Any

from joblib.parallel import ParallelBackendBase

BEAT = 1.0  # seconds between a Dask worker's looks at whether its job is still wanted
PATIENCE = 60.0  # seconds in which Dask's workers must be there

Call = Callable[[], Any]
Around = Callable[[Path], AbstractContextManager[None]]
Cluster = tuple[int, "Futures", Around]  # its cores, what gives it jobs, and the context of a job in some folder


class Futures(ParallelBackendBase):  # type: ignore[misc]
    """Jobs as futures of whatever runs them."""

    supports_retrieve_callback = True

    def __init__(self, begin: Callable[[Call], Future[Any]], cancel: Callable[[Future[Any]], object]) -> None:
        super().__init__()
        self._begin, self._cancel = begin, cancel
        self._futures = set[Future[Any]]()

    def effective_n_jobs(self, n_jobs: int) -> int:
        """Say how many jobs may be under way; two at least, as joblib would run a single one in this process."""
        return max(2, n_jobs)

    def submit(self, func: Call, callback: Callable[[Future[Any]], None]) -> Future[Any]:
        """Begin a job."""
        future = self._begin(func)
        self._futures.add(future)
        future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, out: Future[Any]) -> Any:
        """Say what a job gave; raises what ended it, if that is not in the job."""
        self._futures.discard(out)
        return out.result()

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """End all jobs."""
        for future in self._futures:
            self._cancel(future)
        self._futures.clear()


@contextmanager
def dask(address: str) -> Iterator[Cluster]:
    """Connect to a cluster of Dask's."""
    from distributed import Client

    with Client(address) as client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise ValueError(
                f"the Dask scheduler at {address} has no workers: start some, dask worker {address} --nthreads 1"
            ) from None
        threads = client.nthreads()
        if set(threads.values()) != {1}:
            raise ValueError(
                "a job counts the CPU time of its process, so that Dask's workers must have one thread each: start "
                f"them with --nthreads 1; got {threads}"
            )
        yield len(threads), Futures(client.get_executor(pure=False).submit, Future.cancel), on_dask


@contextmanager
def on_dask(folder: Path) -> Iterator[None]:
    """Work in a folder, and end the worker when nobody wants the job any more: threads cannot be interrupted."""
    from distributed import get_worker

    worker, ended = get_worker(), threading.Event()
    job = worker.state.tasks[worker.get_current_task()]

    def watch() -> None:
        while not ended.wait(BEAT):
            if job.state == "cancelled":
                os._exit(1)  # its nanny starts another

    with chdir(folder):
        if worker.nanny is not None:
            threading.Thread(target=watch, daemon=True).start()
        try:
            yield
        finally:
            ended.set()


@contextmanager
def ray(address: str) -> Iterator[Cluster]:
    """Connect to a cluster of Ray's."""
    import ray

    tasks: dict[Future[Any], Any] = {}

    def begin(call: Call) -> Future[Any]:
        task = ray.remote(num_cpus=1)(_call).remote(call)
        future: Future[Any] = task.future()
        tasks[future] = task
        return future

    if connected := not ray.is_initialized():
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
    try:
        cores = int(ray.cluster_resources().get("CPU", 0))
        yield max(1, cores), Futures(begin, lambda future: ray.cancel(tasks[future], force=True)), chdir
    finally:
        if connected:
            ray.shutdown()


def _call(call: Call) -> Any:
    return call()


CLUSTERS: dict[str, Callable[[str], AbstractContextManager[Cluster]]] = {"dask": dask, "ray": ray}
