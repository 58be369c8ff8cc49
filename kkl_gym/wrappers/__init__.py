"""Wrappers: a learned observer inside an environment, and agents that act more slowly than it samples."""

from kkl_gym.wrappers.estimator import Estimator
from kkl_gym.wrappers.single import ActionRepeat, KKLObservation
from kkl_gym.wrappers.vector import KKLVectorObservation, VectorActionRepeat, VectorEstimate

__all__ = [
    "ActionRepeat",
    "Estimator",
    "KKLObservation",
    "KKLVectorObservation",
    "VectorActionRepeat",
    "VectorEstimate",
]
