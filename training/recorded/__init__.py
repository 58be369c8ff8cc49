"""Observers from recorded states, where nobody knows the equations: ``kkl-gym train --data``."""

from training.recorded.config import RecordedConfig, recorded_config
from training.recorded.fit import Recorded, train_recorded

__all__ = ["Recorded", "RecordedConfig", "recorded_config", "train_recorded"]
