"""Measures of an estimate against the truth."""

import numpy as np


def smape(x: np.ndarray, x_hat: np.ndarray, skip: int = 0) -> np.ndarray:
    """Symmetric mean absolute percentage error of each trajectory (paper, sec. 8.3), in percent.

    mean over the steps of 2 |x - x_hat| / (|x| + |x_hat|) with Euclidean norms.

    Parameters
    ----------
    x, x_hat : (steps, n, nx).
    skip : number of first steps left out.

    Returns
    -------
    (n,), between 0 and 200.
    """
    if x.shape != x_hat.shape or not 0 <= skip < len(x):
        raise ValueError(f"cannot compare {x.shape} with {x_hat.shape} after {skip} steps")
    x, x_hat = x[skip:], x_hat[skip:]
    size = np.linalg.norm(x, axis=-1) + np.linalg.norm(x_hat, axis=-1)
    error = 2.0 * np.linalg.norm(x - x_hat, axis=-1)
    return np.asarray(100.0 * np.mean(np.divide(error, size, out=np.zeros_like(size), where=size > 0), axis=0))
