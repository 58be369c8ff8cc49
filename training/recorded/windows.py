"""From records to pairs of state and filter state at every age: any sample may be a start of the filter."""

from collections.abc import Sequence

import numpy as np

from observers import LinearFilter
from training.records import Record
from training.trajectories.record import Trajectories


def windows(records: Sequence[Record], linear: LinearFilter, *, ages: np.ndarray, n: int) -> Trajectories:
    """Pair recorded states with what the filter holds if it was switched on some samples before.

    The filter is linear. One that starts at sample k therefore differs from one that has run since the record's
    beginning by transition^age times their difference at k, and no window is filtered by itself.

    Parameters
    ----------
    records : sequence of Record
        On a uniform grid with the filter's dt, with states, and with inputs if the filter takes any. No output is
        missing in them; samples that lack a state are left out.
    linear : LinearFilter
        The filter.
    ages : ndarray of int, shape (m,)
        Samples since the start, sorted.
    n : int
        Pairs of each age, spread evenly over all samples that are as old in their records; samples are taken again
        where there are fewer.

    Returns
    -------
    Trajectories
        The columns of x and z are not trajectories: from age to age they belong to different samples.

    Raises
    ------
    ValueError
        If no sample with a state is as old as the greatest age.
    """
    z = [_along(linear, record) for record in records]
    x = [np.full((len(record.t), 0), np.nan) if record.x is None else record.x for record in records]
    known = [np.flatnonzero(~np.isnan(values).any(-1)) if values.shape[1] else np.zeros(0, int) for values in x]
    xs, zs = [], []
    for age in ages:
        old = [samples[samples >= age] for samples in known]
        owner = np.repeat(np.arange(len(records)), [len(samples) for samples in old])
        if not len(owner):
            raise ValueError(
                f"no recorded state is {age * linear.dt:.3g} s after the start of its record, or of a gap; record "
                "longer runs, or take faster eigenvalues"
            )
        chosen = np.linspace(0, len(owner) - 1, n).round().astype(int)
        owner, sample = owner[chosen], np.concatenate(old)[chosen]
        power = np.linalg.matrix_power(linear.transition, int(age))
        own_x, own_z = [], []
        for i in np.unique(owner):
            here = sample[owner == i]
            start = linear.start(records[i].y[here - age])
            own_x.append(x[i][here])
            own_z.append(z[i][here] + (start - z[i][here - age]) @ power.T)
        xs.append(np.concatenate(own_x))
        zs.append(np.concatenate(own_z))
    return Trajectories(ages, np.stack(xs), np.stack(zs), np.zeros(n))


def _along(linear: LinearFilter, record: Record) -> np.ndarray:
    """The filter's states along a whole record, (n, size)."""
    n = len(record.t)
    u = np.zeros((n, 1, 0)) if not linear.nu or record.u is None else record.u[:, None]
    return linear.run(record.y[:, None], u, np.arange(n))[:, 0]
