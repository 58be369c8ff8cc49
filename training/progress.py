"""Progress for people: one kind of bar for everything that takes long, and lines where bars cannot be drawn."""

from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

SECONDS_BETWEEN_LINES = 30.0  # at least, in a log file
SECONDS_OF_SPEED = 24 * 3600.0  # from which the time that is left is estimated: jobs may take hours each


def progress_bars(console: Console | None) -> Progress:
    """Make bars with counts, the time that passed and the time that is left.

    Parameters
    ----------
    console : rich.console.Console or None
        Where they are drawn. On one that is no terminal, a log file, a line now and then says the same. None is silent.

    Returns
    -------
    rich.progress.Progress
        To be entered as a context; ``add_task``, ``update``, ``advance`` and ``track`` say how far something is.
    """
    return _Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console or Console(quiet=True),  # old versions of rich end even disabled bars with a line
        disable=console is None,
        speed_estimate_period=SECONDS_OF_SPEED,
    )


class _Progress(Progress):
    """Bars that are lines in a log file."""

    _last_line = 0.0

    def start(self) -> None:
        self._last_line = self.get_time()
        super().start()

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        self._say(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._say(task_id)

    def _say(self, task_id: TaskID) -> None:
        now, console = self.get_time(), self.console
        drawn = self.disable or console.is_interactive or console.is_jupyter
        if drawn or now - self._last_line < SECONDS_BETWEEN_LINES:
            return
        self._last_line = now
        (task,) = (task for task in self.tasks if task.id == task_id)
        total = "?" if task.total is None else f"{task.total:.0f}"
        passed, left = (column.render(task) for column in (TimeElapsedColumn(), TimeRemainingColumn()))
        line = f"{task.description}: {task.completed:.0f} of {total}, {passed} passed, {left} left"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
