"""Progress bars on a terminal; elsewhere, and in the log of a run, one line a minute with the same content."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from rich import progress as columns
from rich.console import Console
from rich.progress import Progress, Task, TaskID

LOG = "log.txt"  # in the folder of a run

FIRST_LINE, NEXT_LINE = 60.0, 60.0  # seconds before the first line of a phase, and between lines
BEAT = 1.0  # seconds between checks whether a line is due


class ProgressBars(Progress):
    """Bars with counts, elapsed time and remaining time; lines where the console is not a terminal."""

    def __init__(self, console: Console | None, log: Path | None = None, **options: Any) -> None:
        self._drawn = console is not None and (console.is_interactive or console.is_jupyter)
        super().__init__(
            columns.TextColumn("{task.description}", markup=False),
            columns.BarColumn(),
            columns.MofNCompleteColumn(),
            columns.TimeElapsedColumn(),
            columns.TimeRemainingColumn(),
            console=console or Console(quiet=True),
            disable=not self._drawn,
            speed_estimate_period=3600.0,
            **options,
        )
        self._log, self._logged, self._ended = log, False, threading.Event()
        self._due: dict[TaskID, float] = {}

    @contextmanager
    def phase(self, description: str, total: float = 1) -> Iterator[Callable[[float], None]]:
        """Show a phase: the ``with`` block completes it, an error removes it. Yield a function to report progress."""
        task = self.add_task(description, total=total)
        try:
            yield lambda done: self.update(task, completed=done)
        except BaseException:
            self.remove_task(task)
            raise
        self.update(task, completed=total)

    def say(self, text: str) -> None:
        """Print a line above the bars, and write it to the log."""
        self.tell()
        self._write(text, printed=True)

    def start(self) -> None:
        """Begin to draw; a thread writes lines, so that phases appear even if they report no progress."""
        super().start()
        threading.Thread(target=self._beat, daemon=True).start()

    def stop(self) -> None:
        """End the bars and the thread."""
        self._ended.set()
        self.tell()
        if self._drawn:  # old versions of rich print a line even at the end of disabled bars
            super().stop()

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        super().__exit__(kind, error, traceback)
        if error is not None and self._logged:  # an invalid command must not create a log
            self._write(f"ended by {type(error).__name__}{': ' if str(error) else ''}{error}", printed=False)

    def tell(self) -> None:
        """Write a line for each task whose next line is due, or that has ended after at least a minute."""
        with self._lock:
            for task in self.tasks:
                passed = (task.finished_time if task.finished else task.elapsed) or 0.0
                due = self._due.get(task.id, FIRST_LINE)
                if due < math.inf and passed >= (FIRST_LINE if task.finished else due):
                    self._due[task.id] = math.inf if task.finished else passed + NEXT_LINE
                    self._write(_line(task, passed), printed=not self._drawn)

    def _beat(self) -> None:
        while not self._ended.wait(BEAT):
            self.tell()

    def _write(self, text: str, *, printed: bool) -> None:
        if printed:
            self.console.print(text, markup=False, highlight=False, soft_wrap=True)
        if self._log is not None:
            self._logged = True
            self._log.parent.mkdir(parents=True, exist_ok=True)
            with self._log.open("a", encoding="utf-8") as file:
                file.write(f"{datetime.now().isoformat(' ', 'seconds')} {text}\n")


@contextmanager
def progress_bars(console: Console | ProgressBars | None, log: Path | None = None) -> Iterator[ProgressBars]:
    """Make progress bars, or pass on those that are given."""
    if isinstance(console, ProgressBars):
        yield console
    else:
        with ProgressBars(console, log) as progress:
            yield progress


def _line(task: Task, passed: float) -> str:
    count = "" if task.total is None else f" {task.completed:.0f} of {task.total:.0f},"
    left = None if task.finished else task.time_remaining
    rest = "" if left is None else f", {timedelta(seconds=round(left))} left"
    return f"{task.description}:{count} {timedelta(seconds=round(passed))} passed{rest}"
