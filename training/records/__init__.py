"""Recorded data: files of samples, the columns that are asked of them, what is checked, and uniform grids."""

from training.records.checks import check_dt, check_memory, check_signals
from training.records.episodes import Episode, Rollouts
from training.records.reading import read_records
from training.records.record import Record
from training.records.resampling import jitter, median_step, pieces, resampled, sampling_interval
from training.records.signals import Signals

__all__ = [
    "Episode",
    "Record",
    "Rollouts",
    "Signals",
    "check_dt",
    "check_memory",
    "check_signals",
    "jitter",
    "median_step",
    "pieces",
    "read_records",
    "resampled",
    "sampling_interval",
]
