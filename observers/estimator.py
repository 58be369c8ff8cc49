"""What every estimator of a state does, whatever it is made of."""

from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

State = TypeVar("State")


class Estimate(NamedTuple):
    """Estimates of a batch at one time.

    Parameters
    ----------
    x_hat : ndarray, shape (n, nx)
        The estimated states.
    covariance : ndarray, shape (n, nx, nx), optional
        Covariances of their errors, where the estimator has them.
    score : ndarray, shape (n,), optional
        How well samples fit estimates, where they are watched: beyond 1 a fault is likely.
    """

    x_hat: np.ndarray
    covariance: np.ndarray | None = None
    score: np.ndarray | None = None


class Estimator(Protocol[State]):
    """A batch of n rows, of which each is an estimator of its own; the caller keeps its state.

    No method changes a state that it is given, so that a state is also a snapshot. A single sample is a batch of one.
    """

    def start(self, n: int) -> State:
        """Return the state of n rows before their first sample."""
        ...

    def advance(self, state: State, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> State:
        """Return the state after samples y (n, ny), NaN where missing, and inputs u (n, nu) held for dt before them.

        The first sample of a row, which must be whole, begins it; the input before it is ignored.
        """
        ...

    def estimate(self, state: State) -> Estimate:
        """Return the estimates at the last samples."""
        ...


def drive(estimator: Estimator[Any], y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
    """Return the estimates along records y (steps, n, ny) and inputs u (steps - 1, n, nu); (steps, n, nx)."""
    state, found = estimator.start(y.shape[1]), []
    for k, sample in enumerate(y):
        state = estimator.advance(state, sample, None if u is None or not k else u[k - 1])
        found.append(estimator.estimate(state).x_hat)
    return np.array(found)


__all__ = ["Estimate", "Estimator", "drive"]
