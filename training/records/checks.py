"""What may be wrong with records that are well formed: units, lengths, signals that stand still, steps of time."""

from collections.abc import Callable, Sequence

import numpy as np

from kkl_gym.system import System
from training.records.record import ROLES, Record
from training.records.resampling import LONGEST_GAP, median_step

Warn = Callable[[str], object]

MANY = 5  # records of which the same is to be said
OTHER_UNITS = 100.0  # times what is expected: no motion does that, but a unit a thousand times smaller
OTHER_SPREAD = 300.0  # times that of other records of the same signal
OTHER_CLOCK = 30.0  # times the sampling interval of other records
WHOLE_TURN = 0.9 * 2 * np.pi  # jumps from here to a whole turn are those of a wrapped angle


def check_signals(records: Sequence[Record], system: System | None = None) -> None:
    """See that there are records, with the same columns, and as many of them as a system has signals."""
    if not records:
        raise ValueError("there is no record")
    first = records[0]
    for record in records[1:]:
        for role in ROLES.values():
            here, there = getattr(record.signals, role), getattr(first.signals, role)
            if here != there:
                told = [", ".join(names) or "none" for names in (here, there)]
                raise ValueError(f"{record.name}: {role} are columns {told[0]}, but {told[1]} in {first.name}")
        if record.environment != first.environment:
            raise ValueError(
                f"{record.name} is of {_of(record)}, but {first.name} of {_of(first)}: one observer serves one of them"
            )
    if system is None:
        return
    counts = {"measured": system.ny, "inputs": system.nu, "hidden": system.nx}
    for role, count in counts.items():
        found = getattr(first.signals, role)
        if len(found) != count and (found or role == "measured"):
            raise ValueError(
                f"{first.name}: {system.name} has {count} {role}, but the columns are {', '.join(found) or 'none'}; "
                f"name others by --{role}"
            )


def _of(record: Record) -> str:
    found = record.environment
    return "no environment that is known" if found is None else f"{found['id']} with arguments {found['kwargs']}"


def check_between_records(records: Sequence[Record], warn: Warn) -> None:
    """See that no record seems to be in other units than the others."""
    steps = np.array([median_step(record) for record in records])
    for record, step in zip(records, steps):
        if not 1 / OTHER_CLOCK < step / np.median(steps) < OTHER_CLOCK:
            raise ValueError(
                f"{record.name}: column {record.signals.time}: steps of {step:g} s, but {np.median(steps):g} s in the "
                "other files; is the time in other units than seconds?"
            )
    for letter, role in ROLES.items():
        for j, column in enumerate(getattr(records[0].signals, role)):
            spreads = np.array([_spread(record, letter, j) for record in records])
            usual = np.median(spreads[spreads > 0]) if (spreads > 0).any() else 1.0
            if len(records) == 2 and spreads.all():
                usual = spreads.min()
            for record, spread in zip(records, spreads):
                if spread and not 1 / OTHER_SPREAD < spread / usual < OTHER_SPREAD:
                    warn(
                        f"{record.name}: column {column} spreads over {spread / usual:.3g} times what it does in other "
                        "files; is it in other units?"
                    )


def _spread(record: Record, letter: str, j: int) -> float:
    """Standard deviation of a column; exactly 0 where it never moves, which rounding may keep from that."""
    values = getattr(record, letter)[:, j]
    return 0.0 if np.nanmax(values) == np.nanmin(values) else float(np.nanstd(values))


def check_motion(records: Sequence[Record], warn: Warn) -> None:
    """See that signals move, and that no angle jumps by whole turns."""
    for letter, role in (("y", "measured"), ("x", "hidden")):
        for j, column in enumerate(getattr(records[0].signals, role)):
            moves = any(_spread(record, letter, j) for record in records)
            value, *others = (np.nanmax(getattr(record, letter)[:, j]) for record in records)
            if not moves and all(other == value for other in others):
                raise ValueError(
                    f"{records[0].name}: column {column}: {value:g} in all rows, and no other file says more; there is "
                    "nothing to learn from what never moves"
                )
            still, wrapped = list[str](), list[str]()
            for record in records:
                values = getattr(record, letter)[:, j]
                if moves and not _spread(record, letter, j):
                    still.append(f"{record.name}: column {column} never moves")
                jumps = abs(np.diff(values))
                turns = np.flatnonzero((jumps > WHOLE_TURN) & (jumps < 2 * np.pi + 0.1))
                if len(turns) and np.nanmax(values) - np.nanmin(values) < 2 * np.pi + 0.1:
                    wrapped.append(
                        f"{record.name}: column {column}, row {turns[0] + 2}: a jump by a whole turn, as of an angle "
                        f"that is wrapped; take cos({column}) and sin({column}), or unwrap it"
                    )
            _warn_of(still, warn)
            _warn_of(wrapped, warn)


def _warn_of(found: Sequence[str], warn: Warn) -> None:
    """Tell what was found in several records; of many, as episodes are, the first alone."""
    if len(found) > MANY:
        found = [f"{found[0]} (and {len(found) - 1} more like that)"]
    for text in found:
        warn(text)


def check_against_system(records: Sequence[Record], system: System, warn: Warn) -> None:
    """See that records are of sizes that a system may reach."""
    if system.nu and not records[0].signals.inputs:
        warn(f"{records[0].name}: no column of inputs, which are taken for zero")
    for record in records:
        ratio = median_step(record) / system.dt
        told = (
            f"{record.name}: column {record.signals.time}: steps of {median_step(record):.3g} s are {ratio:.3g} "
            f"times the dt of {system.name} ({system.dt:g} s); is the time in seconds?"
        )
        if ratio > OTHER_UNITS:  # nothing is left of the motion between such samples
            raise ValueError(f"{told} If so, give the system a dt as long")
        if ratio < 1 / OTHER_UNITS:
            warn(told)
    low, high = system.box()
    sizes = {"y": np.array(system.output_range), "u": np.array(system.u_max), "x": high - low}
    for record in records:
        for letter, role in ROLES.items():
            values = getattr(record, letter)
            if values is None:
                continue
            largest = np.nanpercentile(abs(values - np.nanmedian(values, 0)), 99, axis=0)  # a few outliers aside
            for column, size, expected in zip(getattr(record.signals, role), largest, sizes[letter], strict=True):
                ratio = size / expected
                told = (
                    f"{record.name}: column {column} moves by {size:.3g}, {ratio:.3g} times what {system.name} declares"
                )
                if ratio > OTHER_UNITS:
                    raise ValueError(f"{told} ({expected:.3g}); is it in other units?")
                if letter != "u" and 0 < ratio < 1 / OTHER_UNITS:
                    warn(f"{told} ({expected:.3g}); is it in other units?")


def check_memory(records: Sequence[Record], seconds: float, warn: Warn) -> None:
    """See that records are longer than what a filter remembers."""
    short = [record for record in records if record.duration < seconds]
    told = [
        f"{record.name}: column {record.signals.time}, row {len(record.t)}: the record ends after "
        f"{record.duration:.3g} s, but the filter remembers {seconds:.3g} s"
        for record in short
    ]
    if len(short) == len(records):
        raise ValueError(f"{told[0]}, and no other is longer; record longer runs, or take faster eigenvalues")
    _warn_of(told, warn)


def check_dt(records: Sequence[Record], dt: float) -> None:
    """See that records were sampled often enough for a sampling interval."""
    for record in records:
        step = median_step(record)
        if not dt / OTHER_CLOCK < step <= LONGEST_GAP * dt:
            raise ValueError(
                f"{record.name}: column {record.signals.time}: steps of {step:g} s do not fit dt = {dt:g} s; is the "
                "time in seconds? If so, take an observer with another dt"
            )
