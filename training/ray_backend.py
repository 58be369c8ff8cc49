"""Ray's tasks as a backend of joblib.

The one that comes with Ray gives the next job to the next worker in turn, whether that is free or not.
"""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import ray
from joblib.parallel import ParallelBackendBase


class RayTasks(ParallelBackendBase):  # type: ignore[misc]
    """Each batch of jobs is a task of one core, which Ray gives to a free worker, and to another if that dies."""

    supports_retrieve_callback = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._running = dict[Future[Any], Any]()

    def effective_n_jobs(self, n_jobs: int) -> int:
        """Say how many batches may be under way; two at least, as joblib would run a single one in this process."""
        return max(2, n_jobs)

    def submit(self, func: Callable[[], Any], callback: Callable[[Future[Any]], None]) -> Future[Any]:
        """Begin a batch."""
        task = ray.remote(num_cpus=1)(_call).remote(func)
        future: Future[Any] = task.future()
        self._running[future] = task
        future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, future: Future[Any]) -> Any:
        """Say what a batch gave; raises whatever ended it."""
        self._running.pop(future, None)
        return future.result()

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """End the workers that are at a batch."""
        for task in self._running.values():
            ray.cancel(task, force=True)


def _call(func: Callable[[], Any]) -> Any:
    return func()
