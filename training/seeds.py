"""Streams of random numbers: whatever the seeds, no two purposes share one."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """First entry of the seeds of each purpose. Entries never change: published results rest on them."""

    TRAINING = 1
    EVALUATION = 2
    VALIDATION = 3  # on which the benchmark chooses
    CERTIFICATE = 4
    CALIBRATION = 5
    FAULTS = 6
    TUNING = 7


def generator(stream: Stream, *seed: int) -> np.random.Generator:
    """Make the generator of a stream for a seed, and for a part of its draws."""
    for entry in seed:
        if not 0 <= entry < 2**32:
            raise ValueError(f"seed = {entry} must be a whole number from 0 to 2**32 - 1")
    return np.random.default_rng([stream, *seed])
