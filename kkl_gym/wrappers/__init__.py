"""Wrappers: a learned observer in an environment, a memory around any, agents that act more slowly than it samples."""

from kkl_gym.wrappers.estimator import Estimates
from kkl_gym.wrappers.memory import KKLMemory, KKLVectorMemory
from kkl_gym.wrappers.single import ActionRepeat, KKLObservation
from kkl_gym.wrappers.vector import KKLVectorObservation, VectorActionRepeat, VectorEstimate

__all__ = [
    "ActionRepeat",
    "Estimates",
    "KKLMemory",
    "KKLObservation",
    "KKLVectorMemory",
    "KKLVectorObservation",
    "VectorActionRepeat",
    "VectorEstimate",
]
