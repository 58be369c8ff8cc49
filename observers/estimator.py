"""The interface of all state estimators."""

from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

State = TypeVar("State")


class Estimate(NamedTuple):
    """Estimates (n, nx) at one time, with their error covariances (n, nx, nx) and a monitor's scores (n,), if any."""

    x_hat: np.ndarray
    covariance: np.ndarray | None = None
    score: np.ndarray | None = None


class Estimator(Protocol[State]):
    """A batch of n independent estimators, one in each row; the caller keeps their state.

    No method changes a given state, so every state is also a snapshot. A single sample is a batch of one.
    """

    def start(self, n: int) -> State:
        """Return the state of n rows before their first sample."""

    def advance(self, state: State, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> State:
        """Return the state after samples y (n, ny), NaN where missing, and inputs u (n, nu) held for dt before them.

        A row starts at its first complete sample; earlier u are ignored. By default u is 0, dt the sampling interval.
        """

    def estimate(self, state: State) -> Estimate:
        """Return the estimates at the last samples."""


class Running:
    """An estimator together with its state."""

    def __init__(self, estimator: Estimator[Any]) -> None:
        self.estimator = estimator
        self.state: Any = None

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """Start at first samples (n, ny), and return the estimates (n, nx)."""
        self.state = self.estimator.advance(self.estimator.start(len(y0)), y0)
        return self.decode()

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> None:
        """Restart those rows where ``rows`` (n,) is True, at first samples (number of True, ny)."""
        begun, state = self.estimator.advance(self.estimator.start(len(y0)), y0), []
        for before, after in zip(self.state, begun, strict=True):
            state.append(before.copy())
            state[-1][rows] = after
        self.state = type(self.state)(*state)

    def advance(self, y: np.ndarray, u: np.ndarray | None = None, rows: np.ndarray | None = None) -> None:
        """Process samples (n, ny) after inputs (n, nu), in all rows or where ``rows`` (n,) is True."""
        state = self.estimator.advance(self.state, y, u)
        if rows is not None:
            for before, after in zip(self.state, state, strict=True):
                after[~rows] = before[~rows]
        self.state = state

    def step(self, y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Process samples, and return the estimates (n, nx)."""
        self.advance(y, u)
        return self.decode()

    def decode(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the estimates of all rows, (n, nx), or of those where ``rows`` (n,) is True."""
        x_hat = self.estimator.estimate(self.state).x_hat
        return x_hat if rows is None else x_hat[rows]

    def along(self, y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Return estimates (steps, n, nx) along records of outputs (steps, n, ny) and inputs (steps - 1, n, nu)."""
        first = self.reset(y[0])
        return np.array([first, *(self.step(y[k], None if u is None else u[k - 1]) for k in range(1, len(y)))])
