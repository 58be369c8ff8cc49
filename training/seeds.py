"""Streams of random numbers by purpose: two purposes never share a stream, whatever their seeds."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """The first entry of NumPy's seed, by purpose. Published results depend on these numbers, which never change."""

    TRAINING = 1
    EVALUATION = 2
    VALIDATION = 3  # splits and diagnosis of records, and the benchmark's choice of settings
    CALIBRATION = 5
    FAULTS = 6
    TUNING = 7


def generator(stream: Stream, *seed: int) -> np.random.Generator:
    """Make a generator for a purpose and a seed. A number > 0 after the seed selects another stream of the purpose."""
    for entry in seed:
        if not 0 <= entry < 2**32:
            raise ValueError(f"seed = {entry} must be a whole number from 0 to 2**32 - 1")
    return np.random.default_rng([stream, *seed])
