"""Statistics of trained agents' scores: normalised interquartile means over seeds, with bootstrap intervals."""

import warnings
from typing import Any

import numpy as np
import scipy


def normalised(scores: Any, top: Any, idle: float) -> np.ndarray:
    """Scale scores so that ``idle`` (an idle agent's score) is 0 and ``top`` (of agents on the full state) is 1."""
    span = np.where(np.asarray(top) > idle, np.asarray(top) - idle, np.nan)
    return np.asarray((scores - idle) / span)


def middle(values: np.ndarray, axis: int = -1) -> Any:
    """Return the interquartile mean along an axis."""
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def interval(values: np.ndarray, best: np.ndarray, idle: float) -> tuple[float, float, float]:
    """Return the interquartile mean of agents' normalised scores, with a bootstrap 95 % interval.

    With only five agents the interval covers the true value in about nine of ten cases.

    Shapes: ``values`` (n,), the agents' scores; ``best`` (m,), the scores of agents on the full state.
    """

    def statistic(mine: np.ndarray, tops: np.ndarray = best, axis: int = -1) -> np.ndarray:
        return normalised(middle(mine, axis), middle(tops, axis), idle)

    score = float(statistic(values))
    if min(len(values), len(best)) < 3 or np.isnan(score):
        return score, np.nan, np.nan
    samples = (values,) if values is best else (values, best)
    with warnings.catch_warnings():  # an interval is NaN if a resample of ``best`` has an interquartile mean <= idle
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)
        resampled = scipy.stats.bootstrap(samples, statistic, n_resamples=2000, method="percentile", rng=0)
    ends = resampled.confidence_interval
    return score, float(ends.low), float(ends.high)
