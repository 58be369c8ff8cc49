"""Learning KKL observers offline: data, forward and inverse maps, evaluation. Needs the extra ``train``."""

from training.config import Config, preset
from training.evaluate import errors, unseen_runs
from training.metrics import smape
from training.pipeline import Result, train

__all__ = ["Config", "Result", "errors", "preset", "smape", "train", "unseen_runs"]
