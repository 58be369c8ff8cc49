"""Progress for people: one kind of bar for everything that takes long, and lines where bars cannot be drawn.

A line says what a bar would: ``simulating lorenz: 30 of 100, 0:00:30 passed, 0:01:10 left``. A thread writes it, so
that nothing that takes long is silent, whether it tells how far it is or not.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

LOG = "log.txt"  # in the folder of a run

FIRST_LINE = 5.0  # seconds after which a phase is said to be under way
SECONDS_BETWEEN_LINES = 15.0  # at first; a twentieth of the time that passed later on
MOST_BETWEEN_LINES = 60.0
BEAT = 1.0  # seconds between looks at the clock


class ProgressBars(Progress):
    """Bars with counts, the time that passed and the time that is left; on what is no terminal, a line now and then.

    ``add_task``, ``update``, ``advance`` and ``track`` are those of :class:`rich.progress.Progress`.
    """

    def __init__(self, console: Console | None, log: Path | None = None, **options: Any) -> None:
        drawn = console is not None and (console.is_interactive or console.is_jupyter)
        super().__init__(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            _Left(),
            console=console or Console(quiet=True),
            disable=not drawn,
            **options,
        )
        self._written = None if drawn else console
        self._log, self._logged = log, False
        self._due: dict[TaskID, float] = {}
        self._ended = threading.Event()

    def bar(self, description: str, total: float | None = None) -> Callable[[float], None]:
        """Begin a phase."""
        task = self.add_task(description, total=total)
        return lambda done: self.update(task, completed=done)

    @contextmanager
    def phase(self, description: str, total: float = 1) -> Iterator[Callable[[float], None]]:
        """Show a phase for as long as the context lasts."""
        task = self.add_task(description, total=total)
        try:
            yield lambda done: self.update(task, completed=done)
        except BaseException:
            self.remove_task(task)
            raise
        self.update(task, completed=total)

    def say(self, text: str) -> None:
        """Print a line above the bars, and to the log."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)
        self._append(text)

    def add_task(
        self,
        description: str,
        start: bool = True,
        total: float | None = 100.0,
        completed: int = 0,
        visible: bool = True,
        **fields: Any,
    ) -> TaskID:
        """Begin a task, as :meth:`rich.progress.Progress.add_task` does."""
        task = super().add_task(description, start, total, completed, visible, first=completed, **fields)
        self._due[task] = self.get_time() + FIRST_LINE
        return task

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Change a task, as :meth:`rich.progress.Progress.update` does."""
        super().update(task_id, **changes)
        self.tell()

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Add to what is done, as :meth:`rich.progress.Progress.advance` does."""
        super().advance(task_id, advance)
        self.tell()

    def start(self) -> None:
        """Begin to draw, or to write."""
        super().start()
        if self._written is not None or self._log is not None:
            threading.Thread(target=self._beat, daemon=True).start()

    def stop(self) -> None:
        """End it."""
        self._ended.set()
        if not self.disable:  # old versions of rich end even disabled bars with a line
            super().stop()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, traceback)
        if error is not None and self._logged:  # what was refused leaves nothing behind
            self._append(f"ended by {type(error).__name__}{': ' if str(error) else ''}{error}")

    def tell(self) -> None:
        """Write a line for each task that is due."""
        if self._written is None and self._log is None:
            return
        now = self.get_time()
        for task in self.tasks:
            with self._lock:
                due = self._due.get(task.id)
                if due is None or (now < due and not task.finished):
                    continue
                passed = task.elapsed or 0.0
                pause = min(max(SECONDS_BETWEEN_LINES, passed / 20), MOST_BETWEEN_LINES)
                self._due[task.id] = now + pause
                if task.finished:
                    del self._due[task.id]
                    if passed < FIRST_LINE:
                        continue
            line = _line(task)
            if self._written is not None:
                self._written.print(line, markup=False, highlight=False, soft_wrap=True)
            self._append(line)

    def _beat(self) -> None:
        while not self._ended.wait(BEAT):
            self.tell()

    def _append(self, text: str) -> None:
        if self._log is None:
            return
        self._logged = True
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now().isoformat(' ', 'seconds')} {text}\n")


@contextmanager
def progress_bars(console: Console | ProgressBars | None, log: Path | None = None) -> Iterator[ProgressBars]:
    """Make bars, unless there are some already."""
    if isinstance(console, ProgressBars):
        yield console
    else:
        with ProgressBars(console, log) as progress:
            yield progress


def under_way(what: str, names: Iterable[str]) -> str:
    """Describe jobs by what they are and the names of those that run: ``observers (now lorenz/ekf)``."""
    running = ", ".join(names)
    return f"{what} (now {running})" if running else what


class _Left(ProgressColumn):
    """The time that is left."""

    def render(self, task: Task) -> Text:
        left = _left(task)
        return Text("-:--:--" if left is None else _clock(left), style="progress.remaining")


def _left(task: Task) -> float | None:
    """Seconds that are left of a task at its mean speed; None if nobody knows."""
    done = task.completed - task.fields.get("first", 0)
    if task.total is None or task.elapsed is None or done <= 0:
        return None
    return max(0.0, (task.total - task.completed) * task.elapsed / done)


def _line(task: Task) -> str:
    count = "" if task.total is None else f" {task.completed:.0f} of {task.total:.0f},"
    line = f"{task.description}:{count} {_clock(task.elapsed or 0.0)} passed"
    left = _left(task)
    return line if left is None or task.finished else f"{line}, {_clock(left)} left"


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))


def duration(seconds: float) -> str:
    """Seconds as people say them: 40 s, 12 min, 3.5 h, 2.1 days."""
    for unit, length, limit in (("s", 1, 90), ("min", 60, 5400), ("h", 3600, 48 * 3600)):
        if seconds < limit:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds / 86400:.3g} days"
