"""Recorded data: reading files and episodes, checking them, and resampling to a uniform grid."""

from training.records.checks import check_dt, check_signals
from training.records.files import read_records
from training.records.record import Record, Signals, jitter, median_step, pieces, resampled, sampling_interval

__all__ = ["Record", "Signals", "check_dt", "check_signals", "jitter", "median_step", "pieces"]
__all__ += ["read_records", "resampled", "sampling_interval"]
