"""Checks of the signals, values and time steps of records."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from kkl_gym.system import System
from training.records.record import LONGEST_GAP, ROLES, Record, median_step

Warn = Callable[[str], object]

OTHER_CLOCK = 30.0  # if dt is longer than this many steps of a record, the record's times are probably in another unit
WHOLE_TURN = 0.9 * 2 * np.pi, 2 * np.pi + 0.1  # least and largest jump of a wrapped angle, in rad
FAR_OFF = 10.0  # a value may mark missing samples if its distance from all others is over this multiple of their range


def check_signals(records: Sequence[Record], system: System | None = None) -> None:
    """Raise ValueError if records differ in columns or environment, or if the columns do not fit a given ``system``."""
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
                f"{first.name}: the {role} columns are {', '.join(names[role]) or 'none'}, but {system.name} has "
                f"{count}; name other columns by --{role}"
            )


def check_alike(record: Record, names: Mapping[str, Sequence[str]], environment: Any, other: str) -> None:
    """Raise ValueError unless a record has the signals (by role) and the environment of the data named ``other``."""
    for role, there in names.items():
        if (here := getattr(record.signals, role)) != tuple(there):
            here, there = (", ".join(each) or "none" for each in (here, there))
            raise ValueError(f"{record.name}: {role} are columns {here}, but {there} in {other}")
    if record.environment != environment:
        here, there = (
            "no known environment" if env is None else f"{env['id']} with arguments {env['kwargs']}"
            for env in (record.environment, environment)
        )
        raise ValueError(f"{record.name} has {here}, but {other} has {there}: an observer serves one environment")


def check_motion(records: Sequence[Record], warn: Warn) -> None:
    """Raise ValueError if an output or state never moves; warn of wrapped angles and of values that may mark gaps."""
    least, most = WHOLE_TURN
    for letter, role in (("y", "measured"), ("x", "hidden")):
        for j, column in enumerate(getattr(records[0].signals, role)):
            values = [getattr(record, letter)[:, j] for record in records]
            every, wrapped, marked = np.concatenate(values), list[str](), list[str]()
            if np.nanmin(every) == np.nanmax(every):
                raise ValueError(
                    f"{records[0].name}: column {column}: {np.nanmax(every):g} in all rows and all files: nothing can "
                    "be learned from a signal that never moves"
                )
            for record, each in zip(records, values):
                ends, jumps = (np.nanmin(each), np.nanmax(each)), abs(np.diff(each))
                turns = np.flatnonzero((jumps > least) & (jumps < most))
                if len(turns) and ends[1] - ends[0] < most:
                    wrapped.append(
                        f"{record.name}: column {column}, row {turns[0] + 2}: a jump by a whole turn, as of a wrapped "
                        f"angle; take cos({column}) and sin({column}), or unwrap the angle"
                    )
                for mark in ends:
                    rest = each[~np.isnan(each) & (each != mark)]
                    if len(rest) and abs(rest - mark).min() > FAR_OFF * np.ptp(rest) > 0:
                        row = np.flatnonzero(each == mark)[0] + 1
                        marked.append(
                            f"{record.name}: column {column}, row {row}: {mark:g} is far from all other values, "
                            f"{rest.min():.3g} to {rest.max():.3g}; if it marks missing samples, leave its cells empty"
                        )
            for texts in filter(None, (wrapped, marked)):
                warn(texts[0] + (f" (and {len(texts) - 1} more of this kind)" if len(texts) > 1 else ""))


def check_dt(records: Sequence[Record], dt: float) -> None:
    """Raise ValueError unless the time steps of records fit a sampling interval."""
    for record in records:
        step = median_step(record)
        if not dt / OTHER_CLOCK < step <= LONGEST_GAP * dt:
            raise ValueError(
                f"{record.name}: column {record.signals.time}: steps of {step:g} s do not fit dt = {dt:g} s; is the "
                "time in seconds? If so, take another dt, or records with other steps"
            )
