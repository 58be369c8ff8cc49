"""The filter's states along simulated or recorded outputs."""

import numpy as np

from observers import LinearFilter


def filter_states(linear: LinearFilter, y: np.ndarray, u: np.ndarray, ages: np.ndarray) -> np.ndarray:
    """Return the states at samples ``ages`` (m,) of a record, counted from its start, without repetition.

    Shapes: ``y`` (steps + 1, n, ny), ``u`` (steps, n, nu), held after the output of its row; returns (m, n, size).
    """
    z = linear.start(y[0])
    out = np.empty((len(ages), *z.shape))
    slot = {int(age): i for i, age in enumerate(ages)}
    for k in range(len(y)):
        if k > 0:
            z = linear.advance(z, y[k - 1], u[k - 1], y[k])
        if k in slot:
            out[slot[k]] = z
    return out
