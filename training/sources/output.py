"""The output y = C x of records, by least squares."""

from collections.abc import Sequence

import numpy as np

from training.records import Record

# What C x leaves of an output is noise, unless it is nearly all, or squares of states explain a part of it.
UNTOLD, SQUARES = 0.7, 0.8  # of the output's standard deviation, and of what is left
LITTLE = 0.1  # of that standard deviation: less is taken for noise in any case
ROUNDING = 1e-6  # of an output's size: below it an entry of C, or what is left, is rounding
OUTLIER = 6.0  # standard deviations of what is left, by its median
OF_MEDIAN = 1.4826  # a normal distribution's standard deviation, over the median of its absolute values
LEAST_NOISE = 1e-4  # assumed at least, in standard deviations of the outputs: with R = 0 the gain would not fall


def linear_output(records: Sequence[Record], known: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find C with y = C x, and the standard deviations of what that leaves. Shapes: returns (ny, nx), (ny,).

    A C that is known is taken as it is, whatever it leaves.
    """
    y, x = (np.concatenate([getattr(record, name) for record in records if record.x is not None]) for name in "yx")
    both = np.isfinite(np.column_stack([x, y])).all(-1)
    if not both.any():
        raise ValueError("no sample has all measured and all hidden signals; record them together")
    x, y = x[both], y[both]
    scale = np.sqrt(np.mean(y**2, 0))
    C, left = _fitted(x, y, scale) if known is None else (known, _usual(y - x @ known.T))
    moves = y.std(0)
    least = np.maximum(left, LEAST_NOISE * np.where(moves > ROUNDING * scale, moves, np.where(scale > 0, scale, 1.0)))
    if known is not None:
        return C, least
    i, j = np.triu_indices(x.shape[1])
    _, unexplained = _fitted(np.column_stack([x, x[:, i] * x[:, j], np.ones(len(x))]), y, scale)
    much = left > np.maximum(LITTLE * moves, ROUNDING * scale)
    wrong = much & ((left > UNTOLD * moves) | (unexplained < SQUARES * left))
    signals = records[0].signals
    if other := [name for name, bad in zip(signals.measured, wrong) if bad]:
        raise ValueError(
            f"{', '.join(other)} is no sum of {', '.join(signals.hidden)} without an offset, with which a tracker "
            "compares its samples: train with what is measured, in the same units, among the hidden signals"
        )
    return C, least


def _fitted(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C of a fit that leaves outliers out, and what is usually left, (ny,)."""
    size = np.sqrt(np.mean(x**2, 0))
    size, scale = np.where(size > 0, size, 1.0), np.where(scale > 0, scale, 1.0)
    kept = np.ones(len(x), dtype=bool)
    for _ in range(4):
        C = np.linalg.lstsq(x[kept] / size, y[kept] / scale, rcond=1e-9)[0].T
        C = np.where(np.abs(C) > ROUNDING, C, 0.0) * scale[:, None] / size
        apart = y - x @ C.T
        usual = _usual(apart)
        kept = (np.abs(apart) <= np.maximum(OUTLIER * usual, ROUNDING * scale)).all(-1)
    return C, usual


def _usual(apart: np.ndarray) -> np.ndarray:
    """Standard deviations of noise (n, ny), from medians: outliers do not count."""
    return np.asarray(OF_MEDIAN * np.median(np.abs(apart), axis=0))


__all__ = ["linear_output"]
