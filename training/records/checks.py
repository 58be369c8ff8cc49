"""Checks of well-formed records: units, lengths, signals that do not move, steps of time."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from kkl_gym.system import System
from training.records.record import LONGEST_GAP, ROLES, Record, median_step

Warn = Callable[[str], object]

MAX_WARNINGS = 5  # of the same kind: beyond it the first alone
OTHER_UNITS = 100.0  # times what is expected: no motion does that, but a unit a thousand times smaller
OTHER_SPREAD = 300.0  # times that of other records of the same signal
OTHER_CLOCK = 30.0  # times the sampling interval of other records
WHOLE_TURN = 0.9 * 2 * np.pi, 2 * np.pi + 0.1  # least and largest jump of a wrapped angle


def check_signals(records: Sequence[Record], system: System | None = None) -> None:
    """Raise ValueError unless all records have the same columns, and as many of them as a system has signals."""
    if not records:
        raise ValueError("there is no record")
    first = records[0]
    for record in records[1:]:
        for role in ROLES.values():
            here, there = (", ".join(getattr(each.signals, role)) or "none" for each in (record, first))
            if here != there:
                raise ValueError(f"{record.name}: {role} are columns {here}, but {there} in {first.name}")
        if record.environment != first.environment:
            raise ValueError(
                f"{record.name} is of {_of(record)}, but {first.name} of {_of(first)}: one observer serves one of them"
            )
    if system is None:
        return
    counts = {"measured": system.ny, "inputs": system.nu, "hidden": system.nx}
    for role, count in counts.items():
        names = getattr(first.signals, role)
        if len(names) != count and (names or role == "measured"):
            raise ValueError(
                f"{first.name}: {system.name} has {count} {role}, but the columns are {', '.join(names) or 'none'}; "
                f"name others by --{role}"
            )


def _of(record: Record) -> str:
    env = record.environment
    return "no environment that is known" if env is None else f"{env['id']} with arguments {env['kwargs']}"


def check_between_records(records: Sequence[Record], warn: Warn) -> None:
    """Raise ValueError, or warn, if a record seems to be in other units than the others."""
    steps = np.array([median_step(record) for record in records])
    for record, step in zip(records, steps):
        if not 1 / OTHER_CLOCK < step / np.median(steps) < OTHER_CLOCK:
            raise ValueError(
                f"{_time(record)}: steps of {step:g} s, but {np.median(steps):g} s in the other files; is the time in "
                "other units than seconds?"
            )
    for _, _, column, values in _columns(records):
        spreads = np.array([_spread(each) for each in values])
        usual = np.quantile(spreads[spreads > 0], 0.5, method="lower") if spreads.any() else 1.0
        for record, ratio in zip(records, spreads / usual):
            if ratio and not 1 / OTHER_SPREAD < ratio < OTHER_SPREAD:
                warn(
                    f"{record.name}: column {column} spreads over {ratio:.3g} times what it does in other files; is it "
                    "in other units?"
                )


def check_motion(records: Sequence[Record], warn: Warn) -> None:
    """Raise ValueError, or warn, if signals do not move, or if an angle jumps by whole turns."""
    least, most = WHOLE_TURN
    for letter, _, column, values in _columns(records):
        if letter == "u":
            continue
        moving, still, wrapped = [_spread(each) > 0 for each in values], list[str](), list[str]()
        value, *others = map(np.nanmax, values)
        if not any(moving) and all(other == value for other in others):
            raise ValueError(
                f"{records[0].name}: column {column}: {value:g} in all rows, and no other file says more; there is "
                "nothing to learn from what never moves"
            )
        for record, each, moves in zip(records, values, moving):
            jumps = abs(np.diff(each))
            turns = np.flatnonzero((jumps > least) & (jumps < most))
            if any(moving) and not moves:
                still.append(f"{record.name}: column {column} never moves")
            if len(turns) and np.nanmax(each) - np.nanmin(each) < most:
                wrapped.append(
                    f"{record.name}: column {column}, row {turns[0] + 2}: a jump by a whole turn, as of an angle that "
                    f"is wrapped; take cos({column}) and sin({column}), or unwrap it"
                )
        _warn_of(still, warn)
        _warn_of(wrapped, warn)


def check_against_system(records: Sequence[Record], system: System, warn: Warn) -> None:
    """Raise ValueError, or warn, if records are of sizes that a system hardly reaches."""
    if system.nu and not records[0].signals.inputs:
        warn(f"{records[0].name}: no column of inputs, which are taken for zero")
    for record in records:
        step = median_step(record)
        ratio = step / system.dt
        text = (
            f"{_time(record)}: steps of {step:.3g} s are {ratio:.3g} times the dt of {system.name} ({system.dt:g} s); "
            "is the time in seconds?"
        )
        if ratio > OTHER_UNITS:  # nothing is left of the motion between such samples
            raise ValueError(f"{text} If so, give the system a dt as long")
        if ratio < 1 / OTHER_UNITS:
            warn(text)
    low, high = system.box()
    sizes = {"y": system.output_range, "u": system.u_max, "x": high - low}
    for letter, j, column, values in _columns(records):
        expected = sizes[letter][j]
        for record, each in zip(records, values):
            size = np.nanpercentile(abs(each - np.nanmedian(each)), 99)  # a few outliers aside
            ratio = size / expected
            text = (
                f"{record.name}: column {column} moves by {size:.3g}, {ratio:.3g} times what {system.name} declares "
                f"({expected:.3g}); is it in other units?"
            )
            if ratio > OTHER_UNITS:
                raise ValueError(text)
            if letter != "u" and 0 < ratio < 1 / OTHER_UNITS:
                warn(text)


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


def _spread(values: np.ndarray) -> float:
    """Standard deviation of a column; exactly 0 where it never moves, which rounding may keep from that."""
    return 0.0 if np.nanmax(values) == np.nanmin(values) else float(np.nanstd(values))


def _warn_of(texts: Sequence[str], warn: Warn) -> None:
    """Warn of the same in several records; of many, as episodes are, of the first alone."""
    if len(texts) > MAX_WARNINGS:
        texts = [f"{texts[0]} (and {len(texts) - 1} more like that)"]
    for text in texts:
        warn(text)
