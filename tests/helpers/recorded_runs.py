"""Recorded runs of a plant with a closed-form solution, and settings for a quick fit to them."""

import numpy as np

from training.records import Record, Signals

SIGNALS = Signals("time", ("position",), ("force",), ("speed",))
SMALL = {
    "width": 16,
    "inverse_steps": 500,
    "learning_rate": 0.02,
    "samples": 10,
    "windows": 500,
    "batch": 256,
    "members": 1,
}


def swing(seed, n=600, dt=0.05, jitter=0.0):
    """A run of p'' = -p + u with a piecewise constant force; `jitter` makes the sampling times uneven."""
    rng = np.random.default_rng(seed)
    t = dt * (np.arange(n) + jitter * rng.uniform(-1, 1, n))
    u = np.repeat(rng.uniform(-1, 1, n // 20), 20)
    x = np.empty((n, 2))
    x[0] = rng.uniform(-1, 1, 2)
    for k in range(n - 1):
        angle = t[k + 1] - t[k]
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        x[k + 1] = turn @ (x[k] - [u[k], 0]) + [u[k], 0]
    return Record(f"run{seed}.csv", t, x[:, :1], u[:, None], x[:, 1:], SIGNALS)


def as_csv(path, record):
    """Write a record as a CSV file with a header of its signals."""
    signals = record.signals
    names = [signals.time, *signals.measured, *signals.inputs, *signals.hidden]
    columns = np.column_stack([record.t, record.y, record.u, record.x])
    np.savetxt(path, columns, delimiter=",", header=",".join(names), comments="")
    return str(path)
