"""Extended Kalman filters that know the equations of motion: what a control engineer would try first."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from kkl_gym.simulate import advance_batch
from kkl_gym.system import System
from observers.unscented import Gaussian
from training.sources.simulated import LEAST_PROCESS_NOISE, unknown_start

ASIDE = 1e-4  # of X's half-widths, steps of the central differences
NOISE_FLOOR = 0.002  # the least measurement noise that a filter assumes, in multiples of the system's default


def measurement_covariance(system: System, measurement_noise: float | Sequence[float]) -> np.ndarray:
    """Covariance (ny, ny) of the measurement noise that a filter assumes: at least a part of the system's default."""
    least = NOISE_FLOOR * np.asarray(system.measurement_noise, dtype=float)
    levels = np.maximum(np.asarray(measurement_noise, dtype=float), least)
    return np.diag(np.broadcast_to(levels, (system.ny,)) ** 2)


def process_intensity(system: System, process_noise: float, dt: float) -> np.ndarray:
    """Intensity (nx, nx) of the white noise that a filter assumes for the plant's process noise, never quite 0."""
    assumed = max(process_noise, LEAST_PROCESS_NOISE / system.pace)
    return np.diag((assumed * np.array(system.scale)) ** 2 / 3 * dt)


class ExtendedKalmanFilter:
    """A batch of extended Kalman filters (Jazwinski, 1970, sec. 8.3), in continuous or in discrete time.

    P = Phi P Phi^T + Q dt; Phi and the slope of h are central differences. A filter starts again where its predicted
    mean leaves the system's declared bounds or its covariance is no longer finite. Entries of samples that are NaN are
    missing, and correct nothing; neither does an output that is undefined at the mean, or its slope.

    Shapes: ``Q`` (nx, nx), ``R`` (ny, ny) or (n, ny, ny), ``start`` (nx,) and (nx, nx), ``x`` (n, nx), ``P``
    (n, nx, nx).
    """

    def __init__(
        self, system: System, dt: float, *, Q: np.ndarray, R: np.ndarray, start: Gaussian | None = None
    ) -> None:
        self._system, self._dt, self._Q, self._R = system, dt, Q, R
        self._start = start or unknown_start(system)
        self._low, self._high = (np.array(bound) for bound in zip(*system.bounds, strict=True))

    def reset(self, y0: np.ndarray, start: Gaussian | None = None) -> np.ndarray:
        """Begin with the start, or one of each row, corrected by the first sample (n, ny); returns (n, nx)."""
        self.x, self.P = self._corrected(*(start or self._starts(len(y0))), y0)
        return self.x.copy()

    @property
    def covariance(self) -> np.ndarray:
        """That of the estimates, (n, nx, nx)."""
        return self.P

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> None:
        """Begin again in some rows. Shapes: ``y0`` (number of rows, ny), ``rows`` (n,)."""
        self.x, self.P = self.x.copy(), self.P.copy()
        self.x[rows], self.P[rows] = self._corrected(*self._starts(len(y0)), y0)

    def step(self, y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Predict over one sample and correct. Shapes: ``y`` (n, ny), ``u`` (n, nu); returns (n, nx)."""
        self.advance(y, u)
        return self.x.copy()

    def advance(self, y: np.ndarray, u: np.ndarray | None = None, rows: np.ndarray | None = None) -> None:
        """Do what :meth:`step` does without the estimate, in some rows only if ``rows`` are given."""
        held = np.zeros((self._system.nu, len(y))) if u is None else np.ascontiguousarray(u.T, dtype=float)
        x, P = self._corrected(*self._predicted(held), y)
        if rows is not None:
            x, P = np.where(rows[:, None], x, self.x), np.where(rows[:, None, None], P, self.P)
        self.x, self.P = x, P

    def _starts(self, n: int) -> Gaussian:
        x0, P0 = self._start
        return np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1))

    def _inside(self, x: np.ndarray, P: np.ndarray) -> np.ndarray:
        inside: np.ndarray = np.isfinite(P).all((1, 2)) & (x >= self._low).all(-1) & (x <= self._high).all(-1)
        return inside

    @cached_property
    def _aside(self) -> np.ndarray:
        low, high = self._system.box()
        return np.asarray(ASIDE * (high - low) / 2)

    @np.errstate(over="ignore", invalid="ignore")  # of filters that are lost, which start again
    def _predicted(self, u: np.ndarray) -> Gaussian:
        """Mean and covariance one sample later under held inputs, (nu, n)."""
        (n, nx), aside = self.x.shape, np.diag(self._aside)[..., None]
        starts = np.concatenate([self.x.T[:, None], self.x.T[:, None] + aside, self.x.T[:, None] - aside], 1)
        flat = starts.reshape(nx, -1)
        ends = advance_batch(self._system, flat, np.tile(u, 1 + 2 * nx), np.zeros_like(flat), self._dt)
        ends = ends.reshape(nx, 1 + 2 * nx, n)
        Phi = ((ends[:, 1 : nx + 1] - ends[:, nx + 1 :]) / (2 * self._aside[:, None])).transpose(2, 0, 1)
        return ends[:, 0].T, Phi @ self.P @ Phi.mT + self._Q * self._dt

    def _corrected(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> Gaussian:
        """Mean and covariance given the samples y, (n, ny); lost filters start again."""
        inside = self._inside(x, P)
        if not inside.all():
            x, P = x.copy(), P.copy()
            x[~inside], P[~inside] = self._start
        aside, R = np.diag(self._aside), self._R
        beside = self._system.output(x[:, None] + np.stack([aside, -aside])[:, None])
        H = ((beside[0] - beside[1]) / (2 * self._aside[:, None])).mT
        innovation = y - self._system.output(x)
        missing = ~(np.isfinite(innovation) & np.isfinite(H).all(-1))
        if missing.any():
            innovation, H = np.where(missing, 0.0, innovation), np.where(missing[..., None], 0.0, H)
            R = np.where(missing[:, None, :] | missing[..., None], np.eye(len(R)), R)  # apart from those measured
        S = H @ P @ H.mT + R
        K = np.linalg.solve(S, H @ P).mT
        x = x + (K @ innovation[..., None])[..., 0]
        I_KH = np.eye(x.shape[1]) - K @ H
        return x, I_KH @ P @ I_KH.mT + K @ R @ K.mT  # Joseph's form stays positive
