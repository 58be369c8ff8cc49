"""Batches on which the inverse is fitted."""

from training.maps.samplers.batch import Batch
from training.maps.samplers.closed_loop import ClosedLoopSampler
from training.maps.samplers.forward_map import ForwardMapSampler
from training.maps.samplers.trajectory import AGE_UNIT, TrajectorySampler

Sampler = TrajectorySampler | ClosedLoopSampler | ForwardMapSampler

__all__ = ["AGE_UNIT", "Batch", "ClosedLoopSampler", "ForwardMapSampler", "Sampler", "TrajectorySampler"]
