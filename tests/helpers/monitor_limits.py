"""Limits of a monitor for outputs whose residuals are of unit size."""

import numpy as np

from observers import Limits


def limits(ny=1, **changes):
    values = {
        "levels": np.array([0.0, 1.0]),
        "mean": np.array([[0.3] * ny, [0.5] * ny]),
        "low": np.array([[0.0] * ny, [0.4] * ny]),
        "high": np.array([[0.1] * ny, [2.1] * ny]),
        "window": 0.1,
        "warm_up": 0.05,
        "false_alarms": 0.01,
        "duration": 50.0,
    }
    return Limits(**(values | changes))
