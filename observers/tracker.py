"""The tracker: an unscented Kalman filter that T_inv initialises where it is surer, and again where it diverged."""

import copy
import functools
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.decoder import Decoders
from observers.supervision import INFLATION, Supervision
from observers.thresholds import MANY_ROWS
from observers.tracker_kernel import RELINEARISATIONS, TrackerKernel
from observers.unscented import Gaussian, Points, conditioned, factor, transformed

KNOWN = 1e-3  # standard deviation of a known start, in scaled states


class Tracker:
    """An unscented Kalman filter on the system's equations, or on a learned flow, for a batch of rows.

    The filter starts at the mean and covariance of the states at which motions start, corrected by the first sample.
    Within the first window each step is taken three times: once a sample has corrected a prediction, it also says more
    of where the step began, and the motion is linearised anew over what is left of that uncertainty (Kullberg, Skog and
    Hendeby, 2023).

    The filter converges only locally; T_inv finds the state from anywhere. T_inv's estimate replaces the filter's

    - within the first window where T_inv's covariance has the smaller determinant, and
    - where the filter diverged: the mean square of its innovations over the window (NIS) exceeds its limit, or its
      covariance is no longer positive definite. T_inv's covariance is then that of an age of one window, since what
      misled the filter may have misled z as well.

    An estimate that is off by less than the noise does not show in the NIS, but its innovations are not white: where
    the mean square of their running mean exceeds its limit, the covariance is multiplied by ten.

    A row of the state holds scaled states (nx), their covariance (nx^2), the NIS, the mean square of the innovations'
    running mean, the number of samples seen, and that running mean (ny).
    """

    def __init__(
        self,
        artifact: Artifact,
        decoders: Decoders,
        *,
        measurement_noise: float | tuple[float, ...],
        process_noise: float,
        compiled: bool = False,
    ) -> None:
        motion = artifact.require_motion()
        self._artifact, self._motion, self._decoders, self._singly = artifact, motion, decoders, compiled
        self._dt = artifact.filter.dt
        self._variances = q, r = motion.variances(measurement_noise, process_noise)
        self._Q, self._R = np.diag(q), np.diag(r)
        self._low, self._high = motion.scaled_bounds
        self._units = motion.x_scale[:, None] * motion.x_scale
        self._C = None if artifact.C is None else artifact.C * motion.x_scale
        self._points = Points(kappa=max(3.0 - motion.nx, 0.0), beta=2.0)
        self._supervision = Supervision.of(motion, self._dt)
        self._window = self._supervision.window
        self._factor_ages = motion.factors.ages / self._dt
        shares = artifact.inverse.shares(measurement_noise, process_noise)
        self._log_factors = np.log(motion.factors.at_levels(*shares))
        self._end = motion.nx + motion.nx**2
        self._batch: tuple[int, ...] = ()
        self._state = np.empty((0, self._end + 3 + len(r)))

    @property
    def _x(self) -> np.ndarray:
        """Scaled states, (n, nx)."""
        return self._state[:, : self._motion.nx]

    @property
    def _P(self) -> np.ndarray:
        """Their covariances, (n, nx, nx)."""
        nx = self._motion.nx
        return self._state[:, nx : self._end].reshape(len(self._state), nx, nx)

    @property
    def _nis(self) -> np.ndarray:
        return self._state[:, self._end]

    @property
    def _seen(self) -> np.ndarray:
        return self._state[:, self._end + 2]

    @property
    def estimate(self) -> np.ndarray:
        """The estimates, (..., nx)."""
        motion = self._motion
        return (motion.x_offset + motion.x_scale * self._x).reshape(*self._batch, motion.nx)

    def covariance(self, age: np.ndarray | float) -> np.ndarray:
        """Calibrated covariances of the estimates' errors, (..., nx, nx), at ages in samples."""
        factors = np.exp(np.interp(np.ravel(age), self._factor_ages, self._log_factors))
        return (self._P * self._units * factors[:, None, None]).reshape(*self._batch, *self._units.shape)

    def reset(self, y: np.ndarray, x0: np.ndarray | None = None) -> None:
        """Start at first samples (..., ny), or at known states (..., nx)."""
        motion, self._batch = self._motion, y.shape[:-1]
        flat = y.reshape(-1, y.shape[-1])
        n = len(flat)
        if x0 is None:
            x = np.tile((motion.mean - motion.x_offset) / motion.x_scale, (n, 1))
            P = np.tile(motion.covariance / self._units, (n, 1, 1))
            with np.errstate(over="ignore", invalid="ignore"):
                corrected, left, _, _ = self._corrected(x, P, flat)
            sound = np.isfinite(corrected).all(-1) & np.isfinite(factor(left)).all((1, 2))
            x, P = np.where(sound[:, None], corrected, x), np.where(sound[:, None, None], left, P)
        else:
            x = (x0.reshape(n, motion.nx) - motion.x_offset) / motion.x_scale
            P = np.tile(KNOWN**2 * np.eye(motion.nx), (n, 1, 1))
        seen = np.full((n, 1), 0.0 if x0 is None else self._window)
        watched = np.concatenate([np.ones((n, 2)), seen, np.zeros((n, flat.shape[1]))], 1)
        self._state = self._packed(self._within(x), P, watched)

    def restart(self, rows: np.ndarray, y: np.ndarray, x0: np.ndarray | None = None) -> None:
        """Start again in some rows (...,), at their first samples (k, ny) or known states (k, nx)."""
        begun = copy.copy(self)
        begun.reset(y, x0)
        self._state = self._state.copy()
        self._state[rows.ravel()] = begun._state

    def __copy__(self) -> "Tracker":
        """Another in the same state, which no method changes in place, with the same machine code."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def take_over(self, other: "Tracker") -> None:
        """Continue in the state of another tracker, of other noise levels or another motion."""
        self._batch, motion = other._batch, self._motion
        x = (other.estimate.reshape(-1, motion.nx) - motion.x_offset) / motion.x_scale
        self._state = self._packed(self._within(x), other._P * other._units / self._units, other._state[:, self._end :])

    def advance(self, y: np.ndarray, u: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Predict under inputs (..., nu) and correct by samples (..., ny), NaN where missing, in all rows or some.

        Returns the predicted outputs, (..., ny), which are not finite where a covariance broke down.
        """
        n, ny = len(self._state), len(self._motion.least_measurement_noise)
        y, u = y.reshape(n, ny), u.reshape(n, u.shape[-1])
        taken = np.ones(n, dtype=bool) if rows is None else rows.flatten()
        machine = self._machine
        if machine is not None:
            state = self._state.copy()  # callers may hold views of the state before
            expected = machine.advance(state, u, y, taken)
            self._state = state
            return expected.reshape(*self._batch, ny)
        with np.errstate(over="ignore", invalid="ignore"):
            state, expected = self._advanced(y, u)
        sound = np.isfinite(state[:, : self._end].sum(-1))
        state = np.where((taken & sound)[:, None], state, self._state)
        state[taken & ~sound, self._end] = np.inf
        self._state = state
        return expected.reshape(*self._batch, ny)

    def _advanced(self, y: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state after a sample, and the predicted outputs."""
        x, P = self._x, self._P

        def move(s: np.ndarray) -> np.ndarray:
            return self._motion.scaled_step(self._within(s), u, self._dt)

        mean, moved, across = transformed(x, P, function=move, points=self._points)
        moved = moved + self._Q
        new = self._seen < self._window
        for _ in range(RELINEARISATIONS if new.any() else 0):
            again = self._relinearised(x, P, (mean, moved, across), self._corrected(mean, moved, y)[:2], move)
            sound = new & np.isfinite(again[0]).all(-1) & np.isfinite(factor(again[1])).all((1, 2))
            mean, moved = np.where(sound[:, None], again[0], mean), np.where(sound[:, None, None], again[1], moved)
            across = np.where(sound[:, None, None], again[2], across)
        x, P, white, expected = self._corrected(mean, moved, y)
        P, watched = self._watched(P, white, ~np.isnan(y))
        return self._packed(self._within(x), P, watched), expected

    def _relinearised(
        self,
        x: np.ndarray,
        P: np.ndarray,
        predicted: tuple[np.ndarray, ...],
        corrected: tuple[np.ndarray, ...],
        move: Any,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predict again, with the motion linearised about the smoothed start of the step.

        A prediction is a mean, its covariance, and that with the start of the step.
        """
        (mean, moved, across), (known, left) = predicted, corrected
        gain = _solved(moved, across.mT).mT  # of a smoother (Rauch, Tung and Striebel, 1965)
        start = x + (gain @ (known - mean)[..., None])[..., 0]
        spread = P + gain @ (left - moved) @ gain.mT
        around, curved, of_start = transformed(start, (spread + spread.mT) / 2, function=move, points=self._points)
        A = _solved(spread, of_start).mT
        curved = curved - A @ of_start  # what is not linear counts as noise
        return (
            around + (A @ (x - start)[..., None])[..., 0],
            A @ P @ A.mT + (curved + curved.mT) / 2 + self._Q,
            P @ A.mT,
        )

    def _corrected(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Condition predictions on samples; returns them, their covariances, white innovations, predicted outputs."""
        if self._C is None:
            expected, S, across = transformed(x, P, function=self._output, points=self._points)
        else:
            expected, across = self._output(x), P @ self._C.T
            S = self._C @ across
        return *conditioned(x, P, y - expected, S + self._R, across, np.isnan(y)), expected

    def _watched(self, P: np.ndarray, white: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Update the statistics of white innovations (n, ny), and inflate covariances where these are not white."""
        watch, count = self._supervision, seen.sum(-1)
        weight = count / seen.shape[1]  # of the outputs that are measured; fewer scatter more
        per_output = 1 / np.maximum(count, 1)
        nis = self._nis + watch.share * weight * (per_output * (white**2).sum(-1) - self._nis)
        trend = self._state[:, self._end + 3 :]
        trend = trend + watch.trend_share * np.where(seen, white - trend, 0.0)
        square = watch.trend_gain * per_output * (np.where(seen, trend, 0.0) ** 2).sum(-1)
        before = self._state[:, self._end + 1]
        trend_square = before + watch.trend_square_share * weight * (square - before)
        coloured = (trend_square > watch.trend_limit) & (count > 0)
        P = np.where(coloured[:, None, None], INFLATION * P, P)
        trend_square, trend = np.where(coloured, 1.0, trend_square), np.where(coloured[:, None], 0.0, trend)
        return P, np.column_stack([nis, trend_square, self._seen + (count > 0), trend])

    def supervise(self, z: np.ndarray, age: np.ndarray | float, rows: np.ndarray | None = None) -> None:
        """Take T_inv's estimate of z, (..., size), at ages in samples, where it is surer or the filter diverged."""
        lost = ~(self._nis <= self._supervision.limit)
        asked = lost | (self._seen < self._window)
        if rows is not None:
            asked = asked & rows.ravel()
        where = np.flatnonzero(asked)
        if not len(where):
            return
        flat, lost = z.reshape(len(self._state), z.shape[-1])[where], lost[where]
        ages = np.broadcast_to(age, self._batch).ravel()[where]
        learned = np.minimum(self._seen[where], self._window)
        x, P = self._inverted(flat, ages * self._dt, learned * self._dt, where)
        taken = lost.copy()
        with np.errstate(invalid="ignore"):
            taken[~lost] = np.linalg.slogdet(P[~lost])[1] < np.linalg.slogdet(self._P[where[~lost]])[1]
        if not taken.any():
            return
        self._state = self._state.copy()
        s = self._within((x - self._motion.x_offset) / self._motion.x_scale)
        self._x[where[taken]], self._P[where[taken]] = s[taken], P[taken]
        again = where[lost]
        self._state[again, self._end : self._end + 2] = 1.0
        self._state[again, self._end + 3 :] = 0.0

    def _inverted(self, z: np.ndarray, age: np.ndarray, learned: np.ndarray, where: np.ndarray) -> Gaussian:
        """T_inv's estimates of z in some rows and their covariances in scaled states, at ages in seconds."""
        return self._decoders(z, age), self._decoders.covariances(z, learned) / self._units

    def _packed(self, x: np.ndarray, P: np.ndarray, watched: np.ndarray) -> np.ndarray:
        return np.concatenate([x, P.reshape(len(x), x.shape[1] ** 2), watched], axis=1)

    def _output(self, s: np.ndarray) -> np.ndarray:
        def output(s: np.ndarray) -> np.ndarray:
            return self._artifact.output(self._motion.x_offset + self._motion.x_scale * s)

        y = output(s)
        if s.ndim == 3 and not np.isfinite(y).all():  # sigma points may lie where h is undefined
            y = np.where(np.isfinite(y), y, output(self._within(s)))
            y = np.where(np.isfinite(y), y, y[0])
        return y

    def _within(self, s: np.ndarray) -> np.ndarray:
        return np.minimum(np.maximum(s, self._low), self._high)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_kernel"}  # made again where it goes

    @property
    def _machine(self) -> TrackerKernel | None:
        """The compiled step, where it is to be used."""
        return self._kernel if len(self._state) >= MANY_ROWS or (self._singly and not self._batch) else None

    @functools.cached_property
    def _kernel(self) -> TrackerKernel | None:
        try:
            return TrackerKernel(self._motion, self._artifact, self._dt, self._supervision, variances=self._variances)
        except ImportError:
            return None


def _solved(P: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solve P X = b, (n, nx, k), for covariances P; NaN where one is not positive definite."""
    root = factor(P)
    solved: np.ndarray = np.linalg.solve(root.mT, np.linalg.solve(root, b))
    return solved


__all__ = ["Tracker"]
