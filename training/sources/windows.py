"""From records to pairs of state and filter state at every age: any sample may be a start of the filter."""

from collections.abc import Sequence

import numpy as np

from observers import LinearFilter
from training.records import Record
from training.sources.source import Pairs
from training.trajectories.filtering import filter_states


def windows(records: Sequence[Record], linear: LinearFilter, *, ages: np.ndarray, n: int) -> Pairs:
    """Pair recorded states with what the filter holds if it was switched on some samples before.

    The filter is linear. One that starts at sample k therefore differs from one that has run since the record's
    beginning by transition^age times their difference at k, and no window is filtered by itself.
    """
    z = [along(linear, record) for record in records]
    xs, zs = [], []
    for age in ages:
        owner, sample = samples_as_old(records, int(age))
        if not len(owner):
            raise ValueError(
                f"no recorded state is {age * linear.dt:.3g} s after the start of its record, or of a gap; record "
                "longer runs, or take faster eigenvalues"
            )
        chosen = np.linspace(0, len(owner) - 1, n).round().astype(int)
        owner, sample = owner[chosen], sample[chosen]
        xs.append(taken([record.x for record in records], owner, sample))
        zs.append(restarted(linear, records, z, owner=owner, sample=sample, age=int(age)))
    return Pairs(ages, np.stack(xs), np.stack(zs), np.zeros(n))


def samples_as_old(records: Sequence[Record], age: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the samples with a state that have so many before them. Shapes: returns ``owner, sample`` (n,)."""
    found = [
        np.zeros(0, int) if record.x is None else age + np.flatnonzero(~np.isnan(record.x[age:]).any(-1))
        for record in records
    ]
    return np.repeat(np.arange(len(records)), [len(samples) for samples in found]), np.concatenate(found)


def taken(values: Sequence[np.ndarray | None], owner: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Rows of arrays, one for each record, as :func:`samples_as_old` names them; none of them is of a missing one."""
    return np.concatenate([np.asarray(values[i])[sample[owner == i]] for i in np.unique(owner)])


def restarted(
    linear: LinearFilter,
    records: Sequence[Record],
    z: Sequence[np.ndarray],
    *,
    owner: np.ndarray,
    sample: np.ndarray,
    age: int,
) -> np.ndarray:
    """What the filter holds at m samples if it was switched on ``age`` samples before each: (m, size)."""
    began = sample - age
    start = linear.start(taken([record.y for record in records], owner, began))
    power = np.linalg.matrix_power(linear.transition, age)
    return np.asarray(taken(z, owner, sample) + (start - taken(z, owner, began)) @ power.T)


def along(linear: LinearFilter, record: Record) -> np.ndarray:
    """The filter's states along a whole record, (n, size)."""
    n = len(record.t)
    u = np.zeros((n, 1, 0)) if not linear.nu or record.u is None else record.u[:, None]
    return filter_states(linear, record.y[:, None], u, np.arange(n))[:, 0]
