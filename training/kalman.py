"""Kalman filters that know the equations of motion: what a control engineer would try first."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kkl_gym.simulate import advance_batch
from kkl_gym.system import System
from observers.estimator import Estimate
from observers.unscented import Gaussian
from training.sources.simulated import LEAST_PROCESS_NOISE, unknown_start
from training.trajectories.derivatives import evaluate, jacobian

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


class Belief(NamedTuple):
    """Means (n, nx), covariances (n, nx, nx), normalised innovations squared (n,), and whether rows have begun (n,)."""

    x: np.ndarray
    P: np.ndarray
    nis: np.ndarray
    begun: np.ndarray


class KalmanFilter(ABC):
    """A batch of Kalman filters in NumPy, in continuous time between samples or in discrete time.

    They are an :class:`observers.estimator.Estimator`. A filter that loses its way, out of the system's declared bounds
    or to a covariance that is none, starts anew. Entries of samples that are NaN are missing, and correct nothing.

    Shapes: ``Q`` (nx, nx), ``R`` (ny, ny), ``start`` (nx,) and (nx, nx).
    """

    def __init__(
        self, system: System, dt: float, *, Q: np.ndarray, R: np.ndarray, start: Gaussian | None = None
    ) -> None:
        self._system, self._dt, self._Q, self._R = system, dt, Q, R
        self._start = start or unknown_start(system)
        self._low, self._high = (np.array(bound) for bound in zip(*system.bounds, strict=True))

    def start(self, n: int) -> Belief:
        """Return n rows before their first sample."""
        return Belief(*self._starts(n), np.zeros(n), np.zeros(n, dtype=bool))

    def advance(self, state: Belief, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> Belief:
        """Predict over dt, by default that of the samples, in rows that have begun; then correct."""
        x, P, begun = state.x, state.P, state.begun
        if begun.any():
            held = np.zeros((self._system.nu, len(y))) if u is None else np.ascontiguousarray(u.T, dtype=float)
            moved, spread = self._predicted(x, P, held, self._dt if dt is None else dt)
            x, P = np.where(begun[:, None], moved, x), np.where(begun[:, None, None], spread, P)
        return Belief(*self._corrected(x, P, y), np.ones(len(y), dtype=bool))

    def estimate(self, state: Belief) -> Estimate:
        """Return means and covariances."""
        return Estimate(state.x.copy(), state.P.copy())

    def _starts(self, n: int) -> Gaussian:
        x0, P0 = self._start
        return np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1))

    def _inside(self, x: np.ndarray, P: np.ndarray) -> np.ndarray:
        inside: np.ndarray = np.isfinite(P).all((1, 2)) & (x >= self._low).all(-1) & (x <= self._high).all(-1)
        return inside

    @abstractmethod
    def _predicted(self, x: np.ndarray, P: np.ndarray, u: np.ndarray, dt: float) -> Gaussian:
        """Mean and covariance after dt under held inputs, (nu, n)."""

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
    def _predicted(self, x: np.ndarray, P: np.ndarray, u: np.ndarray, dt: float) -> Gaussian:
        (n, nx), aside = x.shape, np.diag(self._aside)[..., None]
        starts = np.concatenate([x.T[:, None], x.T[:, None] + aside, x.T[:, None] - aside], 1)
        flat = starts.reshape(nx, -1)
        ends = advance_batch(self._system, flat, np.tile(u, 1 + 2 * nx), np.zeros_like(flat), dt)
        ends = ends.reshape(nx, 1 + 2 * nx, n)
        Phi = ((ends[:, 1 : nx + 1] - ends[:, nx + 1 :]) / (2 * self._aside[:, None])).transpose(2, 0, 1)
        return ends[:, 0].T, Phi @ P @ Phi.mT + self._Q * dt

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
