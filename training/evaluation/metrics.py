"""Error measures of each trajectory; an estimate that is not finite counts as infinitely far from the state."""

import numpy as np

from training.maps.coordinates import STILL


def smape(x: np.ndarray, x_hat: np.ndarray, skip: int = 0) -> np.ndarray:
    """Symmetric mean absolute percentage error (paper, sec. 8.3), in percent, between 0 and 200.

    It is the mean over the steps of 2 |x - x_hat| / (|x| + |x_hat|) with Euclidean norms.

    Parameters
    ----------
    x, x_hat : ndarray, shape (steps, n, nx)
        States and estimates.
    skip : int
        Number of initial steps to leave out.

    Returns
    -------
    ndarray, shape (n,)
        Error of each trajectory in percent.

    Raises
    ------
    ValueError
        If the shapes differ, or no step is left.
    """
    x, x_hat = _compared(x, x_hat, skip)
    size = np.linalg.norm(x, axis=-1) + np.linalg.norm(x_hat, axis=-1)
    error = np.linalg.norm(x - x_hat, axis=-1)
    ratio = np.divide(error, size, out=np.zeros_like(size), where=(size > 0) & np.isfinite(size))
    return np.asarray(np.where(np.isfinite(size), 200.0 * ratio, 200.0).mean(0))


def nrmse(x: np.ndarray, x_hat: np.ndarray, skip: int = 0) -> np.ndarray:
    """Root mean square error of each state, in percent of that state's standard deviation.

    The standard deviation is over all steps of all trajectories, skipped steps too, so that small errors stay small
    where motions come to rest. Unlike a norm of all states, this error does not depend on units. Tables show the
    median over the trajectories.

    Parameters
    ----------
    x, x_hat : ndarray, shape (steps, n, nx)
        States and estimates.
    skip : int
        Number of initial steps whose errors are left out.

    Returns
    -------
    ndarray, shape (n, nx)
        Errors in percent; NaN for a state that does not move.

    Raises
    ------
    ValueError
        If the shapes differ, or no step is left.
    """
    late, estimated = _compared(x, x_hat, skip)
    error = np.sqrt(((late - estimated) ** 2).mean(0))
    if not len(error):
        return error
    size = x.std((0, 1))
    moves = size > STILL * np.abs(x).max((0, 1))
    return 100.0 * np.divide(error, size, out=np.full_like(error, np.nan), where=moves)


def by_state(values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns nrmse1, nrmse2, ... of a CSV file, from the values (n, nx) of :func:`nrmse`."""
    return {f"nrmse{i + 1}": column for i, column in enumerate(values.T)}


def _compared(x: np.ndarray, x_hat: np.ndarray, skip: int) -> tuple[np.ndarray, np.ndarray]:
    if x.shape != x_hat.shape or not 0 <= skip < len(x):
        raise ValueError(f"cannot compare states {x.shape} with estimates {x_hat.shape} after skip = {skip} steps")
    return x[skip:], np.where(np.isfinite(x_hat), x_hat, np.inf)[skip:]
