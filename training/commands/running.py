"""Running the jobs of a comparison, with a bar; and where they run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol, TypeVar

import tyro

from training.parallel import Backend, engine
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


@dataclass(frozen=True)
class Workers:
    """Where jobs run; docs/guides/many_machines.md says more."""

    jobs: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: 2, or all cores of a cluster)")] = None
    """Jobs at a time, each in a process of one thread."""
    backend: Backend = "loky"
    """loky: processes of this machine. dask, ray: a cluster that shares the folder of results
    (docs/guides/many_machines.md)."""
    address: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: none)")] = None
    """Of the cluster: tcp://HOST:8786 for Dask's scheduler; auto or HOST:6379 for Ray's head."""


def run_missing(
    run: Callable[[Job], None], jobs: Sequence[Job], *, workers: Workers, what: str, progress: ProgressBars
) -> list[str]:
    """Run the jobs that are not done."""
    todo, failures = [job for job in jobs if not job.done], list[str]()
    names = [job.name for job in todo]  # the engine begins jobs in this order: the first ones run
    bar = progress.add_task(what, total=len(jobs), completed=len(jobs) - len(todo))
    with engine(workers.jobs, backend=workers.backend, address=workers.address) as here:
        progress.update(bar, description=under_way(what, names[: here.workers]))
        for job, failure in here.run(run, todo):
            names.remove(job.name)
            if failure:
                failures.append(f"{job.name}: {failure}")
                progress.say(f"failed {failures[-1]} (in {job.folder})")
            else:
                progress.say(f"finished {job.name}")
            progress.update(bar, advance=1, description=under_way(what, names[: here.workers]))
    return failures
