"""Jobs that write their results to folders, so that an interrupted comparison can continue."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from rich.console import Console

from examples.research.parallel import engine
from training.files import check_identity, claimed_job
from training.progress import LOG, ProgressBars, progress_bars


@dataclass(frozen=True)
class Workers:
    """Options of the worker processes."""

    jobs: int = 2
    """Number of simultaneous jobs, each in a process with one thread."""


class Job(ABC):
    """A part of a comparison; derived dataclasses hold its settings and the field ``folder``."""

    folder: Path
    result: ClassVar[str]
    """Name of the file that the job writes last."""
    other: ClassVar[str]
    """Describes, in errors, the content of a folder with another identity."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The job's name in progress and errors."""

    @property
    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Everything on which the result depends."""

    @abstractmethod
    def work(self) -> None:
        """Compute the result and write it."""

    @property
    def done(self) -> bool:
        """Whether the result exists; ValueError if it is from a job with another identity."""
        if not (self.folder / self.result).exists():
            return False
        check_identity(self.folder / "job.json", self.identity, self.other)
        return True


def run_job(job: Job) -> None:
    """Run a job in one thread, unless it is done."""
    import torch  # imported here, so that --help does not wait for torch

    torch.set_num_threads(1)
    with claimed_job(job.folder, job.identity, job.other):
        if not job.done:
            job.work()


def run_and_report(
    jobs: Sequence[Job],
    out: Path,
    console: Console,
    *,
    workers: Workers,
    what: str,
    report: Callable[[ProgressBars], None],
) -> None:
    """Run the jobs that are not done, then report on the results, also after an interruption or an error."""
    failures = list[str]()
    try:
        with progress_bars(console, out / LOG) as progress:
            failures = run_missing(run_job, jobs, workers=workers, what=what, progress=progress)
    finally:
        with progress_bars(console, out / LOG) as progress, progress.phase("collecting results"):
            report(progress)
    check_failures(failures, jobs, what)


def run_missing(
    run: Callable[[Job], None], jobs: Sequence[Job], *, workers: Workers, what: str, progress: ProgressBars
) -> list[str]:
    """Run the jobs that are not done; returns a text for each job that failed."""
    todo, failures = [job for job in jobs if not job.done], list[str]()
    names = [job.name for job in todo]  # engine() starts jobs in this order, so the first ones are running
    bar = progress.add_task(what, total=len(jobs), completed=len(jobs) - len(todo))

    def described() -> str:
        running = ", ".join(names[: here.workers])
        return f"{what} (now {running})" if running else what

    with engine(workers.jobs) as here:
        progress.update(bar, description=described())
        for job, failure in here.run(run, todo):
            names.remove(job.name)
            if failure:
                failures.append(f"{job.name}: {failure}")
                progress.say(f"failed {failures[-1]} (in {job.folder})")
            else:
                progress.say(f"finished {job.name}")
            progress.update(bar, advance=1, description=described())
    return failures


def check_failures(failures: Sequence[str], jobs: Sequence[Job], what: str) -> None:
    """Raise ValueError with the first failure if any job failed."""
    if failures:
        raise ValueError(f"{len(failures)} of {len(jobs)} {what} failed; the first: {failures[0]}")
