"""Sampling intervals as machine code, where Numba is installed and takes a system's equations."""

from kkl_gym.compiled.batch import batch_step
from kkl_gym.compiled.single import single_step
from kkl_gym.compiled.step import SamplingStep

__all__ = ["SamplingStep", "batch_step", "single_step"]
