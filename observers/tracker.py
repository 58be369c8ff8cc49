"""The tracker: an unscented Kalman filter that T_inv initialises, and reinitialises after a divergence."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from observers.artifact import Artifact
from observers.decoder import Decoders
from observers.motion import Motion
from observers.unscented import add, factor, shift, solved, transformed, whitened

# The two limits of Supervision follow from these quantiles of the normal distribution. Beyond the limit of the NIS, the
# tracker discards its estimate; beyond that of the mean square of the trend (the innovations' running mean), it raises
# P. This mean square is more skewed than chi-square: for white innovations its tail probability is 2e-4, not 1e-5.
_DIVERGED = 6.0  # for the NIS, with tail probability 1e-9
_COLOURED = 4.265  # for the mean square of the trend, with tail probability 1e-5
_TREND = 0.25  # time constant of the trend, in multiples of Motion.window
_LONG = 4.0  # time constant of the mean square of the trend, in multiples of Motion.window
INFLATION = 10.0  # factor by which the covariance grows if innovations are not white
RELINEARISATIONS = 2  # number for each step in the first window; with 0, noise-free errors are 40 to 80 % larger
KNOWN = 1e-3  # assumed standard deviation of a known initial state, in multiples of Motion.x_scale


@dataclass(frozen=True)
class Supervision:
    """Limits of the innovations' running statistics, valid at any noise level, and a new sample's share in each."""

    window: int
    share: float
    limit: float
    trend_share: float
    trend_square_share: float
    trend_limit: float

    @classmethod
    def of(cls, motion: Motion, dt: float) -> Self:
        """Return the supervision for a model of the motion, with samples every ``dt`` seconds."""
        window, ny = max(1, round(motion.window / dt)), len(motion.least_measurement_noise)
        share, trend_share, long_share = (-math.expm1(-1 / (each * window)) for each in (1.0, _TREND, _LONG))
        memory = (1 - trend_share) ** 2 * (1 - long_share)  # squares of successive trends are correlated
        return cls(
            window,
            share,
            _limit(ny * (2 - share) / share, _DIVERGED),
            trend_share,
            long_share,
            _limit(ny * (2 - long_share) / long_share * (1 - memory) / (1 + memory), _COLOURED),
        )

    @property
    def trend_gain(self) -> float:
        """Factor that scales the square of a trend to a mean of 1 for white innovations."""
        return (2 - self.trend_share) / self.trend_share


def _limit(freedom: float, quantile: float) -> float:
    """Return the limit of a mean of ``freedom`` squared normal numbers at a quantile (Wilson and Hilferty, 1931)."""
    spread = 2 / (9 * freedom)
    return float((1 - spread + quantile * math.sqrt(spread)) ** 3)


class Tracker:
    """An unscented Kalman filter on the system's equations or a learned :class:`Flow`, with one estimate in each row.

    It starts from the initial states' mean and covariance in training, corrected by the first sample. In the first
    :attr:`Motion.window` each step is repeated twice: the sample also corrects the state before the step, and the
    motion is linearised about this smoothed state (Kullberg et al., 2023). A known initial state skips this window.

    A Kalman filter converges only locally; T_inv finds the state from anywhere. T_inv's estimate replaces the tracker's
    in two cases: in the first window, if T_inv's covariance has the smaller determinant; and after a divergence. The
    tracker has diverged if the mean square of its innovations over the window (NIS) exceeds a limit, or if its
    covariance is no longer positive definite. T_inv's covariance is taken at an age of at most one window, because the
    cause of the divergence may have disturbed z, too.

    Estimation errors smaller than the noise still correlate the innovations. If the mean square of the innovations'
    running mean exceeds its limit, the covariance is multiplied by ten.

    A gate, in standard deviations of the innovation, rejects outputs with larger innovations; they then count as
    missing. The gate is open in the first window. It also opens for an output that it has rejected for a whole window,
    and after a divergence, until the output fits again. So a lasting jump is accepted.

    Each row, which the caller keeps, holds the estimate x (nx), its covariance P (nx^2), the NIS, the mean
    square of the innovations' running mean, the number of samples seen, the number of outputs rejected, the number of
    successive samples beyond the gate (ny), and the running mean of the innovations (ny).
    """

    def __init__(
        self,
        artifact: Artifact,
        decoders: Decoders,
        *,
        measurement_noise: float | tuple[float, ...],
        process_noise: float,
        gate: float | None = None,
    ) -> None:
        self.gate = math.inf if gate is None else gate
        self._artifact, self._decoders, self._dt = artifact, decoders, artifact.filter.dt
        self.motion = motion = artifact.require_motion()
        self.supervision = Supervision.of(motion, self._dt)
        q, self.r = motion.variances(measurement_noise, process_noise)
        self.q = q * motion.x_scale**2
        self._Q, self._R = np.diag(self.q), np.diag(self.r)
        shares = artifact.inverse.shares(measurement_noise, process_noise)
        self._log_factors = np.log(motion.factors.at_levels(*shares))
        self.x, self.P = slice(motion.nx), slice(motion.nx, motion.nx + motion.nx**2)
        self.nis, ny = self.P.stop, len(self.r)
        self.trends = self.nis + 4 + ny
        self.width = self.trends + ny

    def covariance(self, rows: np.ndarray, age: np.ndarray) -> np.ndarray:
        """Return the calibrated error covariances (n, nx, nx) of rows whose ages (n,) are in samples since reset."""
        factors = np.exp(np.interp(age * self._dt, self.motion.factors.ages, self._log_factors))
        return self._covariances(rows) * factors[:, None, None]

    def begin(self, y: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
        """Return rows that start at first samples (n, ny), or at known states (n, nx)."""
        motion, n = self.motion, len(y)
        if x0 is None:
            x, P = np.tile(motion.mean, (n, 1)), np.tile(motion.covariance, (n, 1, 1))
            with np.errstate(over="ignore", invalid="ignore"):
                expected, S, across = self._expected(x, P)
                V, white = whitened(y - expected, S, across, np.isnan(y))
                corrected, left = shift(x, V, white), add(P, V, V, -1.0)
            sound = np.isfinite(corrected).all(-1) & np.isfinite(factor(left)).all((1, 2))
            x, P = np.where(sound[:, None], corrected, x), np.where(sound[:, None, None], left, P)
        else:
            x, P = x0, np.tile(np.diag((KNOWN * motion.x_scale) ** 2), (n, 1, 1))
        seen = np.full((n, 1), 0.0 if x0 is None else self.supervision.window)
        return self._packed(x, P, np.concatenate([np.ones((n, 2)), seen, np.zeros((n, 1 + 2 * y.shape[1]))], 1))

    def take_over(self, rows: np.ndarray) -> np.ndarray:
        """Return another tracker's rows, with their estimates limited to this tracker's bounds of the states."""
        rows = rows.copy()
        rows[:, self.x] = self._within(rows[:, self.x])
        return rows

    def advance(
        self, rows: np.ndarray, y: np.ndarray, u: np.ndarray, samples: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict rows by ``samples`` intervals under inputs (n, nu), and correct by outputs (n, ny), NaN if missing.

        Returns the rows, and the outputs (n, ny), in which predictions replace missing and rejected outputs. The
        predictions are not finite if the covariance is not positive definite.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            advanced, whole = self._advanced(rows, y, u, samples)
        broken = ~np.isfinite(advanced[:, : self.nis].sum(-1))
        if broken.any():
            advanced[broken] = rows[broken]
            advanced[broken, self.nis] = np.inf
        return advanced, whole

    def _advanced(
        self, rows: np.ndarray, y: np.ndarray, u: np.ndarray, samples: float
    ) -> tuple[np.ndarray, np.ndarray]:
        def move(x: np.ndarray) -> np.ndarray:
            return self._within(self.motion.step(self._within(x), u, self._dt, samples))

        def predict(x: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            mean, moved, across = transformed(x, P, move)
            return mean, moved + samples * self._Q, across

        x, P = rows[:, self.x], self._covariances(rows)
        mean, moved, across = predict(x, P)
        expected, S, cross = self._expected(mean, moved)
        y, rejected = self._gated(rows, y, y - expected, S)
        V, white = whitened(y - expected, S, cross, np.isnan(y))
        new = rows[:, self.nis + 2] < self.supervision.window
        for _ in range(RELINEARISATIONS if new.any() else 0):
            # The sample corrects the state before the step by G @ white, too (Rauch, Tung and Striebel, 1965).
            G = across @ solved(moved, V)
            spread = add(P, G, G, -1.0)
            around, curved, of_start = predict(shift(x, G, white), spread)
            D = of_start.mT @ solved(spread, G)
            again = shift(around, D, -white), add(curved, D, D), add(of_start, G, D)
            sound = new & np.isfinite(again[0]).all(-1) & np.isfinite(factor(again[1])).all((1, 2))
            mean = np.where(sound[:, None], again[0], mean)
            moved, across = (np.where(sound[:, None, None], *each) for each in zip(again[1:], (moved, across)))
            expected, S, cross = self._expected(mean, moved)
            V, white = whitened(y - expected, S, cross, np.isnan(y))
        P, watched = self._watched(rows[:, self.nis :], add(moved, V, V, -1.0), white, ~np.isnan(y))
        watched[:, 3 : self.trends - self.nis] = rejected
        return self._packed(shift(mean, V, white), P, watched), np.where(np.isnan(y), expected, y)

    def _gated(
        self, rows: np.ndarray, y: np.ndarray, innovation: np.ndarray, S: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return outputs (n, ny), NaN where rejected, and the gate's updated counts (n, 1 + ny); see the class."""
        counts, window = rows[:, self.nis + 3 : self.trends], self.supervision.window
        if self.gate == math.inf:
            return y, counts
        count, in_a_row = counts[:, :1], counts[:, 1:]
        far = innovation**2 > self.gate**2 * np.diagonal(S, axis1=1, axis2=2)
        rejected = far & (in_a_row < window) & (rows[:, self.nis + 2, None] >= window)
        in_a_row = np.where(np.isnan(y), in_a_row, np.where(far, in_a_row + 1, 0.0))
        return np.where(rejected, np.nan, y), np.hstack([count + rejected.sum(1, keepdims=True), in_a_row])

    def _expected(self, x: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the mean and covariance of the expected outputs, and their covariance with the states."""
        C = self._artifact.C
        if C is None:
            expected, S, across = transformed(x, P, self._output)
        else:
            expected, across = x @ C.T, P @ C.T
            S = C @ across
        return expected, S + self._R, across

    def _watched(
        self, watched: np.ndarray, P: np.ndarray, white: np.ndarray, seen: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Update the statistics by whitened innovations (n, ny), and inflate P where innovations are correlated."""
        watch, count = self.supervision, seen.sum(-1)
        (nis, trend_square, samples), trend = watched[:, :3].T, watched[:, -seen.shape[1] :]
        weight = count / seen.shape[1]  # samples with fewer measured outputs weigh less
        per_output = 1 / np.maximum(count, 1)
        nis = nis + watch.share * weight * (per_output * (white**2).sum(-1) - nis)
        trend = trend + watch.trend_share * np.where(seen, white - trend, 0.0)
        square = watch.trend_gain * per_output * (np.where(seen, trend, 0.0) ** 2).sum(-1)
        trend_square = trend_square + watch.trend_square_share * weight * (square - trend_square)
        coloured = (trend_square > watch.trend_limit) & (count > 0)
        if coloured.any():
            P = np.where(coloured[:, None, None], INFLATION * P, P)
            trend_square, trend = np.where(coloured, 1.0, trend_square), np.where(coloured[:, None], 0.0, trend)
        return P, np.column_stack([nis, trend_square, samples + (count > 0), watched[:, 3 : -seen.shape[1]], trend])

    def supervise(self, rows: np.ndarray, z: np.ndarray, age: np.ndarray) -> np.ndarray:
        """Return rows (n, width), with T_inv's estimate where it replaces the tracker's; ``age`` (n,) is in samples."""
        watch, nis, seen = self.supervision, rows[:, self.nis], rows[:, self.nis + 2]
        lost = ~(nis <= watch.limit)
        where = np.flatnonzero(lost | (seen < watch.window))
        if not len(where):
            return rows
        seconds = np.minimum(seen[where], watch.window) * self._dt
        P = self._decoders.covariances(z[where], seconds)
        with np.errstate(invalid="ignore"):
            surer = np.linalg.slogdet(P)[1] < np.linalg.slogdet(self._covariances(rows)[where])[1]
        taken = surer | lost[where]
        where, P, rows = where[taken], P[taken], rows.copy()
        rows[where, self.x] = self._within(self._decoders(z[where], age[where] * self._dt))
        rows[where, self.P] = P.reshape(len(where), self.motion.nx**2)
        rows[lost, self.nis : self.nis + 2] = 1.0
        rows[lost, self.nis + 4 : self.trends] = watch.window
        rows[lost, self.trends :] = 0.0
        return rows

    def _covariances(self, rows: np.ndarray) -> np.ndarray:
        return rows[:, self.P].reshape(len(rows), self.motion.nx, self.motion.nx)

    def _packed(self, x: np.ndarray, P: np.ndarray, watched: np.ndarray) -> np.ndarray:
        return np.concatenate([self._within(x), P.reshape(len(x), x.shape[1] ** 2), watched], axis=1)

    def _output(self, x: np.ndarray) -> np.ndarray:
        y = self._artifact.output(x)
        if not np.isfinite(y).all():  # sigma points may lie where h is undefined
            y = np.where(np.isfinite(y), y, self._artifact.output(self._within(x)))
            y = np.where(np.isfinite(y), y, y[0])
        return y

    def _within(self, x: np.ndarray) -> np.ndarray:
        return np.minimum(np.maximum(x, self.motion.low), self.motion.high)
