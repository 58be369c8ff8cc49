"""Running the jobs of a comparison, with a bar."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from training.jobs import run_all
from training.progress import ProgressBars, under_way


class Kept(Protocol):
    """What a job must have: a name for people, a folder, and whether its result lies there."""

    @property
    def name(self) -> str:
        """For people."""
        ...

    @property
    def folder(self) -> Path:
        """Where its result is to lie."""
        ...

    @property
    def done(self) -> bool:
        """Whether it lies there."""
        ...


Job = TypeVar("Job", bound=Kept)


def run_missing(
    run: Callable[[Job], None], jobs: Sequence[Job], *, workers: int, what: str, progress: ProgressBars
) -> list[str]:
    """Run the jobs that are not done.

    Parameters
    ----------
    run : callable
        What to do with a job; a function of a module.
    jobs : sequence of jobs
        All of them.
    workers : int
        Processes.
    what : str
        What they make, for the bar.
    progress : ProgressBars
        Where the bar is, and what has ended is said.

    Returns
    -------
    list of str
        Names of jobs that failed, each with what went wrong.
    """
    todo, failures = [job for job in jobs if not job.done], list[str]()
    workers = min(workers, max(1, len(todo)))
    bar = progress.add_task(what, total=len(jobs), completed=len(jobs) - len(todo))
    progress.update(bar, description=under_way(what, [job.name for job in todo[:workers]]))
    for job, failure, running in run_all(run, todo, workers):
        if failure:
            failures.append(f"{job.name}: {failure}")
            progress.say(f"failed {failures[-1]} (in {job.folder})")
        else:
            progress.say(f"finished {job.name}")
        progress.update(bar, advance=1, description=under_way(what, running))
    return failures
