"""The Cramér-Rao bound, and a baseline: extended Kalman filters that know the equations of motion."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kkl_gym.simulate import advance_batch
from kkl_gym.system import System
from observers.estimator import Estimate
from training.sources.simulated import unknown_start

Gaussian = tuple[np.ndarray, np.ndarray]
"""Means (..., nx) and covariances (..., nx, nx)."""

ASIDE = 1e-4  # step of the central differences, in half-widths of X
NOISE_FLOOR = 0.002  # least measurement noise that a filter assumes, in multiples of the system's default


def measurement_covariance(system: System, measurement_noise: float | Sequence[float]) -> np.ndarray:
    """Return the covariance (ny, ny) of assumed noise on y; the level is at least ``NOISE_FLOOR`` times the default."""
    least = NOISE_FLOOR * np.asarray(system.measurement_noise, dtype=float)
    levels = np.maximum(np.asarray(measurement_noise, dtype=float), least)
    return np.diag(np.broadcast_to(levels, (system.ny,)) ** 2)


def process_intensity(system: System, process_noise: float, dt: float) -> np.ndarray:
    """Return the intensity (nx, nx) of the white noise by which a filter models the plant's process noise."""
    return np.diag((process_noise * np.array(system.scale)) ** 2 / 3 * dt)


class Belief(NamedTuple):
    """Means (n, nx), covariances (n, nx, nx), and a mask (n,) of the filters that have had a sample."""

    x: np.ndarray
    P: np.ndarray
    begun: np.ndarray


class ExtendedKalmanFilter:
    """A batch of extended Kalman filters (Jazwinski, 1970, sec. 8.3), an :class:`observers.estimator.Estimator`.

    The prediction is P = Phi P Phi^T + Q dt; central differences give Phi and the Jacobian of h. A filter restarts when
    its predicted mean leaves the system's bounds or its covariance is no longer finite. It skips outputs that are NaN,
    or for which h is undefined at the mean.

    Shapes: ``Q`` (nx, nx), ``R`` (ny, ny) or (n, ny, ny), ``start`` (nx,) and (nx, nx), by default from unknown_start.
    """

    def __init__(
        self, system: System, dt: float, *, Q: np.ndarray, R: np.ndarray, start: Gaussian | None = None
    ) -> None:
        self._system, self._dt, self._Q, self._R = system, dt, Q, R
        self._start = start or unknown_start(system)
        self._low, self._high = np.array(system.bounds, dtype=float).T
        low, high = system.box()
        self._aside = ASIDE * (high - low) / 2

    def start(self, n: int) -> Belief:
        """Return the beliefs of n filters before their first sample."""
        x0, P0 = self._start
        return Belief(np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1)), np.zeros(n, dtype=bool))

    def advance(self, state: Belief, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> Belief:
        """Predict over dt (by default the sampling interval) where a filter has had a sample; then correct all."""
        x, P, begun = state
        if begun.any():
            held = np.zeros((self._system.nu, len(y))) if u is None else np.ascontiguousarray(u.T, dtype=float)
            moved, spread = self._predicted(x, P, held, self._dt if dt is None else dt)
            x, P = np.where(begun[:, None], moved, x), np.where(begun[:, None, None], spread, P)
        begun = begun | np.isfinite(y).any(-1)  # a filter begins with its first sample that is not missing
        return Belief(*self._corrected(x, P, np.where(begun[:, None], y, np.nan)), begun)

    def estimate(self, state: Belief) -> Estimate:
        """Return means and covariances."""
        return Estimate(state.x.copy(), state.P.copy())

    def along(self, y: np.ndarray, u: np.ndarray, x: np.ndarray | None = None) -> Gaussian:
        """Return means (steps + 1, n, nx) and covariances for samples (steps + 1, n, ny) and inputs (steps, n, nu).

        Given motions x (steps + 1, n, nx), the filter linearises f about them, and h about predictions from them. With
        the plant's own Q and R, the covariances are each motion's posterior Cramér-Rao bound (Tichavsky et al., 1998).
        """
        state, states = self.start(y.shape[1]), []
        for k in range(len(y)):
            state = state if x is None else state._replace(x=x[max(k - 1, 0)])
            state = self.advance(state, y[k], u[k - 1])  # at k = 0 no filter predicts, and u is not used
            states.append(state)
        means, covariances, _ = zip(*states, strict=True)
        return np.array(means), np.array(covariances)

    def _inside(self, x: np.ndarray, P: np.ndarray) -> np.ndarray:
        return np.isfinite(P).all((1, 2)) & (x >= self._low).all(-1) & (x <= self._high).all(-1)

    @np.errstate(over="ignore", invalid="ignore")  # diverged filters overflow, and restart
    def _predicted(self, x: np.ndarray, P: np.ndarray, u: np.ndarray, dt: float) -> Gaussian:
        """Return means and covariances after dt under held inputs (nu, n)."""
        (n, nx), aside = x.shape, np.diag(self._aside)[..., None]
        starts = np.concatenate([x.T[:, None], x.T[:, None] + aside, x.T[:, None] - aside], 1)
        flat = starts.reshape(nx, -1)
        ends = advance_batch(self._system, flat, np.tile(u, 1 + 2 * nx), np.zeros_like(flat), dt)
        ends = ends.reshape(nx, 1 + 2 * nx, n)
        Phi = ((ends[:, 1 : nx + 1] - ends[:, nx + 1 :]) / (2 * self._aside[:, None])).transpose(2, 0, 1)
        return ends[:, 0].T, Phi @ P @ Phi.mT + self._Q * dt

    def _corrected(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> Gaussian:
        """Return means and covariances given the samples y (n, ny); filters out of bounds restart first."""
        (x0, P0), inside = self._start, self._inside(x, P)
        x, P = np.where(inside[:, None], x, x0), np.where(inside[:, None, None], P, P0)
        aside, R = np.diag(self._aside), self._R
        beside = self._system.output(x[:, None] + np.stack([aside, -aside])[:, None])
        H = ((beside[0] - beside[1]) / (2 * self._aside[:, None])).mT
        innovation = y - self._system.output(x)
        missing = ~(np.isfinite(innovation) & np.isfinite(H).all(-1))
        if missing.any():
            innovation, H = np.where(missing, 0.0, innovation), np.where(missing[..., None], 0.0, H)
            R = np.where(missing[:, None, :] | missing[..., None], np.eye(R.shape[-1]), R)
        S = H @ P @ H.mT + R
        K = np.linalg.solve(S, H @ P).mT
        x = x + (K @ innovation[..., None])[..., 0]
        I_KH = np.eye(x.shape[1]) - K @ H
        return x, I_KH @ P @ I_KH.mT + K @ R @ K.mT  # Joseph's form keeps P positive semidefinite
