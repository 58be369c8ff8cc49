"""Checks of well-formed records: units, lengths, signals that do not move, steps of time."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from kkl_gym.system import System
from training.records.record import LONGEST_GAP, ROLES, Record, median_step

Warn = Callable[[str], object]

MAX_WARNINGS = 5  # of the same kind: beyond it the first alone
OTHER_UNITS = 100.0  # times the expected size: a unit a thousand times smaller exceeds it, a motion does not
OTHER_CLOCK = 30.0  # times the steps of a record, the longest sampling interval that it is put on
WHOLE_TURN = 0.9 * 2 * np.pi, 2 * np.pi + 0.1  # least and largest jump of a wrapped angle
FAR_OFF = 10.0  # ranges of all other samples, between these and a value that marks missing ones


def check_signals(records: Sequence[Record], system: System | None = None) -> None:
    """Raise ValueError unless all records have the same columns, and as many of them as a system has signals."""
    if not records:
        raise ValueError("no records are given")
    first = records[0]
    names = {role: getattr(first.signals, role) for role in ROLES.values()}
    for record in records[1:]:
        check_alike(record, names, first.environment, first.name)
    if system is None:
        return
    for role, count in zip(ROLES.values(), (system.ny, system.nu, system.nx)):
        if len(names[role]) != count and (names[role] or role == "measured"):
            raise ValueError(
                f"{first.name}: {system.name} has {count} {role}, but the columns are "
                f"{', '.join(names[role]) or 'none'}; name others by --{role}"
            )


def check_alike(record: Record, names: Mapping[str, Sequence[str]], environment: Any, other: str) -> None:
    """Raise ValueError unless a record has the signals ``names`` by role and is of an environment, as ``other`` is."""
    for role, there in names.items():
        if (here := getattr(record.signals, role)) != tuple(there):
            here, there = (", ".join(each) or "none" for each in (here, there))
            raise ValueError(f"{record.name}: {role} are columns {here}, but {there} in {other}")
    if record.environment != environment:
        here, there = (
            "no known environment" if env is None else f"{env['id']} with arguments {env['kwargs']}"
            for env in (record.environment, environment)
        )
        raise ValueError(f"{record.name} is of {here}, but {other} of {there}: one observer serves one of them")


def check_motion(records: Sequence[Record], warn: Warn) -> None:
    """Raise ValueError if a signal never moves; warn of wrapped angles and of values that mark missing samples."""
    least, most = WHOLE_TURN
    for letter, _, column, values in _columns(records):
        if letter == "u":
            continue
        ranges = [np.nanmax(each) - np.nanmin(each) for each in values]
        value, *others = map(np.nanmax, values)
        if not any(ranges) and all(other == value for other in others):
            raise ValueError(
                f"{records[0].name}: column {column}: {value:g} in all rows and all files: nothing can be learned from "
                "a signal that never moves"
            )
        texts = defaultdict[str, list[str]](list)
        for record, each, width in zip(records, values, ranges):
            where, jumps = f"{record.name}: column {column}", abs(np.diff(each))
            turns = np.flatnonzero((jumps > least) & (jumps < most))
            if any(ranges) and not width:
                texts["still"].append(f"{where} never moves")
            if len(turns) and width < most:
                texts["wrapped"].append(
                    f"{where}, row {turns[0] + 2}: a jump by a whole turn, as of an angle that is wrapped; take "
                    f"cos({column}) and sin({column}), or unwrap it"
                )
            for mark in (np.nanmin(each), np.nanmax(each)):
                rest = each[~np.isnan(each) & (each != mark)]
                if len(rest) and abs(rest - mark).min() > FAR_OFF * np.ptp(rest) > 0:
                    texts["marked"].append(
                        f"{where}, row {np.flatnonzero(each == mark)[0] + 1}: {mark:g} is far from all other values, "
                        f"{rest.min():.3g} to {rest.max():.3g}; if it marks missing samples, leave their cells empty"
                    )
        for alike in texts.values():
            _warn_of(alike, warn)


def check_units(records: Sequence[Record], system: System | None, warn: Warn) -> None:
    """Raise ValueError, or warn, if a record seems to be in other units than a system, or than most records."""
    if system is not None and system.nu and not records[0].signals.inputs:
        warn(f"{records[0].name}: no column of inputs, which are taken for zero")
    whose = "most files have" if system is None else f"{system.name} has"

    def judge(what: str, sizes: Sequence[float], usual: float | None, question: str, *, fatal: bool = True) -> None:
        usual = usual or np.quantile([size for size in sizes if size] or [1.0], 0.5, method="lower")
        for record, size in zip(records, sizes):
            ratio = size / usual
            text = f"{record.name}: column {what} {size:.3g}, {ratio:.3g} times what {whose} ({usual:.3g}); {question}"
            if ratio > OTHER_UNITS and fatal:
                raise ValueError(text)
            if ratio > OTHER_UNITS or 0 < ratio < 1 / OTHER_UNITS:
                warn(text)

    steps = [median_step(record) for record in records]
    judge(f"{records[0].signals.time}: steps of", steps, system.dt if system else None, "is the time in seconds?")
    declared = {}
    if system is not None:
        declared = {"y": system.output_range, "u": system.u_max, "x": np.ptp(np.array(system.box()), axis=0)}
    for letter, j, column, values in _columns(records):
        # A few outliers aside.
        sizes = [float(np.nanpercentile(abs(each - np.nanmedian(each)), 99)) for each in values]
        usual = declared[letter][j] if declared else None
        if letter == "u" and usual:
            sizes = [max(size, usual / OTHER_UNITS) for size in sizes]  # inputs may be as small as one likes
        judge(f"{column} moves by", sizes, usual, "is it in other units?", fatal=system is not None)


def check_memory(records: Sequence[Record], seconds: float, warn: Warn) -> None:
    """Raise ValueError, or warn, if records are shorter than what a filter remembers."""
    short = [
        f"{_time(record)}, row {len(record.t)}: the record ends after {record.duration:.3g} s, but the filter "
        f"remembers {seconds:.3g} s"
        for record in records
        if record.duration < seconds
    ]
    if len(short) == len(records):
        raise ValueError(f"{short[0]}, and no other is longer; record longer runs, or take faster eigenvalues")
    _warn_of(short, warn)


def check_dt(records: Sequence[Record], dt: float) -> None:
    """Raise ValueError unless records were sampled often enough for a sampling interval."""
    for record in records:
        step = median_step(record)
        if not dt / OTHER_CLOCK < step <= LONGEST_GAP * dt:
            raise ValueError(
                f"{_time(record)}: steps of {step:g} s do not fit dt = {dt:g} s; is the time in seconds? If so, take "
                "an observer with another dt"
            )


def _time(record: Record) -> str:
    return f"{record.name}: column {record.signals.time}"


def _columns(records: Sequence[Record]) -> Iterator[tuple[str, int, str, list[np.ndarray]]]:
    """Each signal as the letter of its array, its number there, its name, and its values in each record."""
    for letter, role in ROLES.items():
        for j, column in enumerate(getattr(records[0].signals, role)):
            yield letter, j, column, [getattr(record, letter)[:, j] for record in records]


def _warn_of(texts: Sequence[str], warn: Warn) -> None:
    """Warn of the same in several records; of many, as episodes are, of the first alone."""
    if len(texts) > MAX_WARNINGS:
        texts = [f"{texts[0]} (and {len(texts) - 1} more like that)"]
    for text in texts:
        warn(text)
