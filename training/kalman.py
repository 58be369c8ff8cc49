"""Kalman filters that know the equations of motion: what a control engineer would try first."""

from typing import Any

import numpy as np

from kkl_gym.simulate import advance, advance_batch
from kkl_gym.system import System
from training.trajectories.derivatives import evaluate, jacobian, with_sensitivity

NOISE_FLOOR = 0.01  # the least standard deviation of measurement noise that a filter assumes


def unknown_start(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Mean (nx,) and covariance (nx, nx) of a start uniform in X."""
    low, high = system.box()
    return (low + high) / 2, np.diag((high - low) ** 2 / 12)


class ExtendedKalmanFilter:
    """A batch of continuous-discrete extended Kalman filters in NumPy (Jazwinski, 1970, sec. 8.3).

    Mean and sensitivity Phi are integrated together over each sample, P = Phi P Phi^T + Q dt. A filter whose
    mean leaves the system's declared bounds starts anew.

    Parameters
    ----------
    system : the model.
    dt : sampling interval in seconds.
    Q : intensity of the process noise, (nx, nx), per second.
    R : covariance of the measurement noise, (ny, ny).
    start : its mean (nx,) and covariance (nx, nx); None is a start uniform in X.
    """

    def __init__(
        self,
        system: System,
        dt: float,
        *,
        Q: np.ndarray,
        R: np.ndarray,
        start: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self._system, self._dt, self._Q, self._R = system, dt, Q, R
        self._start = start or unknown_start(system)
        self._joint = with_sensitivity(system)
        self._outputs = jacobian(system.h, system.nx)
        self._low, self._high = (np.array(bound) for bound in zip(*system.bounds, strict=True))

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """The start, corrected by the first sample."""
        x0, P0 = self._start
        n = len(y0)
        self.x, self.P = self._corrected(np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1)), y0)
        return self.decode()

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> None:
        """Begin anew in some rows, boolean (n,), from their first samples, (number of rows, ny)."""
        x0, P0 = self._start
        n = len(y0)
        self.x, self.P = self.x.copy(), self.P.copy()
        self.x[rows], self.P[rows] = self._corrected(np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1)), y0)

    def step(self, y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Predict over one sample under the input u, (n, nu) or None for zero, and correct."""
        self.advance(y, u)
        return self.decode()

    def advance(self, y: np.ndarray, u: np.ndarray | None = None, rows: np.ndarray | None = None) -> None:
        """:meth:`step` without the estimate; with ``rows``, boolean (n,), in these rows only."""
        n, nx = self.x.shape
        Phi0 = np.broadcast_to(np.eye(nx).reshape(-1, 1), (nx * nx, n))
        joint = np.concatenate([self.x.T, Phi0])
        held = np.zeros((self._joint.nu, n)) if u is None else np.ascontiguousarray(u.T, dtype=float)
        joint = advance_batch(self._joint, joint, held, np.zeros_like(joint), self._dt)
        x, Phi = joint[:nx].T, joint[nx:].T.reshape(n, nx, nx)
        x, P = self._corrected(x, Phi @ self.P @ Phi.mT + self._Q * self._dt, y)
        if rows is not None:
            x, P = np.where(rows[:, None], x, self.x), np.where(rows[:, None, None], P, self.P)
        self.x, self.P = x, P

    def decode(self, rows: np.ndarray | None = None) -> np.ndarray:
        """The estimate as things stand, (n, nx), or of some rows only."""
        return self.x.copy() if rows is None else self.x[rows]

    def _corrected(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inside = np.isfinite(P).all((1, 2)) & (x >= self._low).all(-1) & (x <= self._high).all(-1)
        if not inside.all():
            x, P = x.copy(), P.copy()
            x[~inside], P[~inside] = self._start
        H = evaluate(self._outputs, x)
        S = H @ P @ H.mT + self._R
        K = np.linalg.solve(S, H @ P).mT
        x = x + (K @ (y - self._system.output(x))[..., None])[..., 0]
        I_KH = np.eye(x.shape[1]) - K @ H
        return x, I_KH @ P @ I_KH.mT + K @ self._R @ K.mT  # Joseph's form stays positive


class UnscentedFilters:
    """filterpy's filter for each row of a batch; one that loses positive definiteness or its bounds starts anew."""

    def __init__(
        self,
        system: System,
        dt: float,
        *,
        Q: np.ndarray,
        R: np.ndarray,
        start: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self._system, self._dt, self._Q, self._R = system, dt, Q, R
        self._start = start or unknown_start(system)
        self._low, self._high = (np.array(bound) for bound in zip(*system.bounds, strict=True))

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """The start, corrected by the first sample."""
        self._filters = [self._fresh() for _ in y0]
        for one, y in zip(self._filters, y0, strict=True):
            self._begin(one, y)
        return self._estimates()

    def step(self, y: np.ndarray) -> np.ndarray:
        """Predict over one sample and correct."""
        for i, (one, value) in enumerate(zip(self._filters, y, strict=True)):
            try:
                one.predict()
                one.update(value)
                lost = not ((one.x >= self._low) & (one.x <= self._high)).all()
            except (np.linalg.LinAlgError, ValueError):  # the covariance is no longer positive definite or finite
                lost = True
            if lost:
                self._filters[i] = one = self._fresh()
                self._begin(one, value)
        return self._estimates()

    def _estimates(self) -> np.ndarray:
        return np.array([one.x for one in self._filters]).reshape(-1, self._system.nx)

    def _begin(self, one: Any, y: np.ndarray) -> None:
        one.sigmas_f = one.points_fn.sigma_points(one.x, one.P)
        one.update(y)

    def _fresh(self) -> Any:
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        system = self._system
        no_input, no_noise = [0.0] * system.nu, [0.0] * system.nx

        def fx(x: np.ndarray, dt: float) -> np.ndarray:
            return np.array(advance(system, x.tolist(), no_input, no_noise, dt))

        def hx(x: np.ndarray) -> np.ndarray:
            return np.array(system.h(x))

        points = MerweScaledSigmaPoints(system.nx, alpha=1.0, beta=2.0, kappa=3.0 - system.nx)
        one = UnscentedKalmanFilter(system.nx, system.ny, self._dt, hx, fx, points)
        one.x, one.P = (value.copy() for value in self._start)
        one.Q, one.R = self._Q * self._dt, self._R
        return one
