"""Kalman filters that know the equations of motion: what a control engineer would try first."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from kkl_gym.simulate import advance_batch
from kkl_gym.system import System
from observers.unscented import Gaussian
from training.sources.simulated import LEAST_PROCESS_NOISE, unknown_start
from training.trajectories.equations import evaluate, jacobian

ASIDE = 1e-4  # of X's half-widths, steps of the central differences
NOISE_FLOOR = 0.002  # the least measurement noise that a filter assumes, in multiples of the system's default

Corrected = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Means, covariances and normalised innovations squared (n,) of a batch."""


def measurement_covariance(system: System, measurement_noise: float | Sequence[float]) -> np.ndarray:
    """Covariance (ny, ny) of the measurement noise that a filter assumes: at least a part of the system's default."""
    least = NOISE_FLOOR * np.asarray(system.measurement_noise, dtype=float)
    levels = np.maximum(np.asarray(measurement_noise, dtype=float), least)
    return np.diag(np.broadcast_to(levels, (system.ny,)) ** 2)


def process_intensity(system: System, process_noise: float, dt: float) -> np.ndarray:
    """Intensity (nx, nx) of the white noise that a filter assumes for the plant's process noise, never quite 0."""
    assumed = max(process_noise, LEAST_PROCESS_NOISE / system.pace)
    return np.diag((assumed * np.array(system.scale)) ** 2 / 3 * dt)


class KalmanFilter(ABC):
    """A batch of Kalman filters in NumPy, in continuous time between samples or in discrete time.

    A filter that loses its way, out of the system's declared bounds or to a covariance that is none, starts anew.
    Entries of samples that are NaN are missing, and correct nothing.

    Shapes: ``Q`` (nx, nx), ``R`` (ny, ny), ``start`` (nx,) and (nx, nx), ``x`` (n, nx), ``P`` (n, nx, nx), ``nis``
    (n,).
    """

    def __init__(
        self, system: System, dt: float, *, Q: np.ndarray, R: np.ndarray, start: Gaussian | None = None
    ) -> None:
        self._system, self._dt, self._Q, self._R = system, dt, Q, R
        self._start = start or unknown_start(system)
        self._low, self._high = (np.array(bound) for bound in zip(*system.bounds, strict=True))

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """Begin with the start, corrected by the first sample. Shapes: ``y0`` (n, ny); returns (n, nx)."""
        self.x, self.P, self.nis = self._corrected(*self._starts(len(y0)), y0)
        return self.decode()

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> None:
        """Begin anew in some rows. Shapes: ``y0`` (number of rows, ny), ``rows`` (n,)."""
        self.x, self.P, self.nis = self.x.copy(), self.P.copy(), self.nis.copy()
        self.x[rows], self.P[rows], self.nis[rows] = self._corrected(*self._starts(len(y0)), y0)

    def step(self, y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Predict over one sample and correct. Shapes: ``y`` (n, ny), ``u`` (n, nu); returns (n, nx)."""
        self.advance(y, u)
        return self.decode()

    def advance(self, y: np.ndarray, u: np.ndarray | None = None, rows: np.ndarray | None = None) -> None:
        """Do what :meth:`step` does without the estimate, in some rows only if ``rows`` are given."""
        held = np.zeros((self._system.nu, len(y))) if u is None else np.ascontiguousarray(u.T, dtype=float)
        x, P, nis = self._moved(held, y)
        if rows is not None:
            x, P = np.where(rows[:, None], x, self.x), np.where(rows[:, None, None], P, self.P)
            nis = np.where(rows, nis, self.nis)
        self.x, self.P, self.nis = x, P, nis

    def decode(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Estimates as things stand, (n, nx), or those of some rows only."""
        return self.x.copy() if rows is None else self.x[rows]

    def _starts(self, n: int) -> Gaussian:
        x0, P0 = self._start
        return np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1))

    def _inside(self, x: np.ndarray, P: np.ndarray) -> np.ndarray:
        inside: np.ndarray = np.isfinite(P).all((1, 2)) & (x >= self._low).all(-1) & (x <= self._high).all(-1)
        return inside

    def _moved(self, u: np.ndarray, y: np.ndarray) -> Corrected:
        """What :meth:`_corrected` makes of the samples y, one sample later under held inputs, (nu, n)."""
        return self._corrected(*self._predicted(u), y)

    @abstractmethod
    def _predicted(self, u: np.ndarray) -> Gaussian:
        """Mean and covariance one sample later under held inputs, (nu, n)."""

    @abstractmethod
    def _corrected(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> Corrected:
        """Mean and covariance given the samples y, (n, ny), and their surprise; lost filters start anew."""


def _normalised(innovation: np.ndarray, S: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Innovations squared (n,), in multiples of their covariance S and per output that is measured."""
    squared = (innovation * np.linalg.solve(S, innovation[..., None])[..., 0]).sum(-1)
    nis: np.ndarray = squared / np.maximum((~np.isnan(y)).sum(-1), 1)
    return nis


class ExtendedKalmanFilter(KalmanFilter):
    """A batch of extended Kalman filters (Jazwinski, 1970, sec. 8.3).

    P = Phi P Phi^T + Q dt, with central differences of the flow as Phi. A filter whose predicted mean
    leaves the system's declared bounds starts anew. An output that is undefined there, or its slope, corrects nothing.
    Parameters are those of :class:`KalmanFilter`.
    """

    def __init__(
        self, system: System, dt: float, *, Q: np.ndarray, R: np.ndarray, start: Gaussian | None = None
    ) -> None:
        super().__init__(system, dt, Q=Q, R=R, start=start)
        low, high = system.box()
        self._aside = ASIDE * (high - low) / 2
        self._outputs = jacobian(system.h, system.nx)

    @np.errstate(over="ignore", invalid="ignore")  # of filters that are lost, which start anew
    def _predicted(self, u: np.ndarray) -> Gaussian:
        (n, nx), aside = self.x.shape, np.diag(self._aside)[..., None]
        starts = np.concatenate([self.x.T[:, None], self.x.T[:, None] + aside, self.x.T[:, None] - aside], 1)
        flat = starts.reshape(nx, -1)
        ends = advance_batch(self._system, flat, np.tile(u, 1 + 2 * nx), np.zeros_like(flat), self._dt)
        ends = ends.reshape(nx, 1 + 2 * nx, n)
        Phi = ((ends[:, 1 : nx + 1] - ends[:, nx + 1 :]) / (2 * self._aside[:, None])).transpose(2, 0, 1)
        return ends[:, 0].T, Phi @ self.P @ Phi.mT + self._Q * self._dt

    def _corrected(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> Corrected:
        inside = self._inside(x, P)
        if not inside.all():
            x, P = x.copy(), P.copy()
            x[~inside], P[~inside] = self._start
        H, R, missing = evaluate(self._outputs, x), self._R, np.isnan(y)
        innovation = y - self._system.output(x)
        undefined = ~missing & ~(np.isfinite(innovation) & np.isfinite(H).all(-1))  # as h or its slope may be
        inside, missing = inside & ~undefined.any(-1), missing | undefined
        if missing.any():
            innovation, H = np.where(missing, 0.0, innovation), np.where(missing[..., None], 0.0, H)
            R = np.where(missing[:, None, :] | missing[..., None], np.eye(len(R)), R)  # apart from those measured
        S = H @ P @ H.mT + R
        K = np.linalg.solve(S, H @ P).mT
        x = x + (K @ innovation[..., None])[..., 0]
        I_KH = np.eye(x.shape[1]) - K @ H
        P = I_KH @ P @ I_KH.mT + K @ R @ K.mT  # Joseph's form stays positive
        return x, P, np.where(inside, _normalised(innovation, S, y), np.inf)
