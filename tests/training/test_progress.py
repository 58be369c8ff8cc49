"""Progress bars, and the log lines in their place without a terminal."""

import io
import re
import time
from contextlib import suppress

import pytest
from rich.console import Console

import training.progress
from training.progress import ProgressBars, progress_bars


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(training.progress, "BEAT", 1e6)  # the heartbeat uses another clock
    return Clock()


def console_of(terminal):
    return Console(file=io.StringIO(), force_terminal=terminal, width=80)


def work(progress, clock, *, steps=100, seconds=1.0, completed=0):
    with progress:
        task = progress.add_task("simulating [lorenz]", total=steps, completed=completed)
        for done in range(completed + 1, steps + 1):
            clock.now += seconds
            if done % 2:
                progress.advance(task)
            else:
                progress.update(task, completed=done)
            progress.tell()


def written(clock, log=None, **how):
    console = console_of(terminal=False)
    work(ProgressBars(console, log, get_time=clock), clock, **how)
    return console.file.getvalue().splitlines()


def test_without_a_terminal_lines_are_printed_now_and_then(clock):
    assert written(clock, steps=80) == [
        "simulating [lorenz]: 60 of 80, 0:01:00 passed, 0:00:20 left",
        "simulating [lorenz]: 80 of 80, 0:01:20 passed",
    ]
    assert written(clock, steps=50) == []  # too fast for a line
    assert "simulating [lorenz]: 2 of 4, 2:00:00 passed, 2:00:00 left" in written(clock, steps=4, seconds=3600.0)


def test_a_phase_that_has_ended_keeps_its_duration(clock):
    console = console_of(terminal=False)
    with ProgressBars(console, get_time=clock) as progress:
        for seconds in (10.0, 80.0):
            with progress.phase(f"{seconds:g} s"):
                clock.now += seconds
        clock.now += 100.0
    assert console.file.getvalue() == "80 s: 1 of 1, 0:01:20 passed\n"


def test_steps_before_an_interruption_do_not_count_as_speed(clock):
    lines = written(clock, steps=200, completed=80)
    assert lines[0] == "simulating [lorenz]: 140 of 200, 0:01:00 passed, 0:01:00 left"


def test_a_phase_without_progress_prints_lines(monkeypatch):
    monkeypatch.setattr(training.progress, "FIRST_LINE", 0.0)
    monkeypatch.setattr(training.progress, "BEAT", 0.01)
    console = console_of(terminal=False)
    with progress_bars(console) as progress, progress.phase("bounding T_inv"):
        for _ in range(500):
            time.sleep(0.01)
            if console.file.getvalue():
                break
        assert console.file.getvalue() == "bounding T_inv: 0 of 1, 0:00:00 passed\n"


def test_a_refused_training_leaves_no_log(tmp_path):
    with suppress(ValueError), progress_bars(None, tmp_path / "run" / "log.txt"):
        raise ValueError("x")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("console", [None, console_of(terminal=True)])
def test_a_log_has_lines_with_and_without_bars(console, clock, tmp_path):
    log = tmp_path / "run" / "log.txt"
    work(ProgressBars(console, log, get_time=clock), clock, steps=100)
    with suppress(ValueError), progress_bars(console, log) as progress:
        progress.say("wrote [a] file")
        raise ValueError("x")
    stamp = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d "
    lines = log.read_text().splitlines()
    assert all(re.match(stamp, line) for line in lines)
    assert [re.sub(stamp, "", line) for line in lines] == [
        "simulating [lorenz]: 60 of 100, 0:01:00 passed, 0:00:40 left",
        "simulating [lorenz]: 100 of 100, 0:01:40 passed",
        "wrote [a] file",
        "ended by ValueError: x",
    ]


def test_a_terminal_has_bars_instead(clock):
    console = console_of(terminal=True)
    work(ProgressBars(console, get_time=clock), clock)
    assert "100/100" in console.file.getvalue()
    assert "passed" not in console.file.getvalue()
