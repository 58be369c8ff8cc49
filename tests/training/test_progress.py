"""Progress bars, and what stands for them in a log file."""

import io

import pytest
from rich.console import Console

import training.progress
from training.progress import progress_bars


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    original = training.progress._Progress.__init__
    monkeypatch.setattr(training.progress._Progress, "__init__", lambda *a, **k: original(*a, get_time=clock, **k))
    return clock


def log(terminal):
    return Console(file=io.StringIO(), force_terminal=terminal, width=60)


def work(console, clock, steps=100, seconds=1.0):
    with progress_bars(console) as progress:
        task = progress.add_task("simulating [lorenz]", total=steps)
        for done in range(1, steps + 1):
            clock.now += seconds
            if done % 2:
                progress.advance(task)
            else:
                progress.update(task, completed=done)


def test_a_log_file_has_a_line_now_and_then(clock):
    console = log(terminal=False)
    work(console, clock)
    lines = console.file.getvalue().splitlines()
    assert lines[:3] == [
        "simulating [lorenz]: 30 of 100, 0:00:30 passed, 0:01:10 left",
        "simulating [lorenz]: 60 of 100, 0:01:00 passed, 0:00:40 left",
        "simulating [lorenz]: 90 of 100, 0:01:30 passed, 0:00:10 left",
    ]
    assert len([line for line in lines if "passed" in line]) == 3


def test_jobs_that_take_hours_have_a_time_that_is_left(clock):
    console = log(terminal=False)
    work(console, clock, steps=4, seconds=3600.0)
    assert "2 of 4, 2:00:00 passed, 2:00:00 left" in console.file.getvalue()


def test_a_terminal_has_bars_instead(clock):
    console = log(terminal=True)
    work(console, clock)
    assert "100/100" in console.file.getvalue()
    assert "passed" not in console.file.getvalue()


def test_without_a_console_there_is_nothing(clock, capsys):
    work(None, clock)
    assert capsys.readouterr() == ("", "")
