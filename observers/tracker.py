"""An estimate that goes on with the learned motion of the system, and is corrected by each sample."""

import copy
import math

import numpy as np

from observers.artifact import Artifact
from observers.decoder import Decoders
from observers.unscented import Gaussian, corrected, predicted

# A filter is lost where innovations are as large as that by chance once in 1e9: the normal distribution's quantile.
_BEYOND_CHANCE = 5.998
KNOWN = 1e-3  # standard deviation of a state that is said to be known, in scaled states


class Tracker:
    """An unscented Kalman filter on a learned flow, for a batch of rows.

    It is as good as its flow once it is near the state, and cannot find it: that is what T_inv is for. T_inv says where
    to begin. Within the flow's window from there it says so again where it is surer, by the traces of both covariances
    of scaled states. (Asked for longer, it is surer by chance now and then, and errors rise.) It also says so where the
    tracker is lost: where the mean square of its innovations, over the window, is beyond chance for the levels of noise
    told, or its covariance is none any more. What came before may then have misled z too, so that T_inv is taken for no
    surer than so soon after a reset as the window is long.

    Parameters
    ----------
    artifact : Artifact
        With a flow, error bars and the output h(x).
    decoders : Decoders
        T_inv at the levels of noise.
    measurement_noise : float or tuple of float, length ny
        Standard deviations of the noise on the samples, of all outputs or each.
    process_noise : float
        Level in multiples of the system's scale per second.
    """

    def __init__(
        self,
        artifact: Artifact,
        decoders: Decoders,
        *,
        measurement_noise: float | tuple[float, ...],
        process_noise: float,
    ) -> None:
        flow, self._dt = artifact.require_flow(), artifact.filter.dt
        self._flow, self._artifact, self._decoders = flow, artifact, decoders
        q, r = flow.variances(measurement_noise, process_noise)
        self._Q, self._R = np.diag(q), np.diag(r)
        self._low, self._high = ((bound - flow.x_offset) / flow.x_scale for bound in (flow.low, flow.high))
        self._units = flow.x_scale[:, None] * flow.x_scale
        self._window = max(1, round(flow.window / self._dt))
        self._share = -math.expm1(-1 / self._window)
        self._limit = _largest_mean_square(len(r) * (2 - self._share) / self._share)
        shares = artifact.inverse.shares(measurement_noise, process_noise)
        self._ages, self._log_roots = flow.factors.ages / self._dt, flow.factors.log_roots(*shares)
        self._batch: tuple[int, ...]
        self._x: np.ndarray  # scaled states (n, nx) of the flattened batch
        self._P: np.ndarray
        self._mean_square: np.ndarray

    @property
    def estimate(self) -> np.ndarray:
        """The estimates, (..., nx)."""
        x = self._flow.x_offset + self._flow.x_scale * self._x
        return x.reshape(*self._batch, self._flow.nx)

    def covariance(self, age: np.ndarray | float) -> np.ndarray:
        """Covariances of the estimates' errors, (..., nx, nx), at ages in samples."""
        factors = np.exp(2 * np.interp(age, self._ages, self._log_roots))
        P = self._P * self._units
        return P.reshape(*self._batch, *P.shape[1:]) * np.asarray(factors)[..., None, None]

    def reset(self, z: np.ndarray, age: np.ndarray | float, x0: np.ndarray | None = None) -> None:
        """Begin with what T_inv says of z, (..., size), at ages in samples, or with states that are known."""
        self._batch = z.shape[:-1]
        z = z.reshape(-1, z.shape[-1])
        if x0 is None:
            self._begin(*self._said(z, np.broadcast_to(age, self._batch).ravel()))
        else:
            x = np.reshape(x0, (-1, self._flow.nx)).astype(float)
            self._begin(x, np.broadcast_to(np.diag((KNOWN * self._flow.x_scale) ** 2), (*x.shape, x.shape[-1])))

    def restart(self, rows: np.ndarray, z: np.ndarray, age: float, x0: np.ndarray | None = None) -> None:
        """Begin anew in some rows (...,), with what T_inv says of their z, (k, size), or with their known states."""
        if not rows.any():
            return
        begun, where = copy.copy(self), rows.ravel()
        begun.reset(z, age, x0)
        self._own()
        self._x[where], self._P[where], self._mean_square[where] = begun._x, begun._P, begun._mean_square

    def go_on(self, other: "Tracker") -> None:
        """Go on where another stands, which may be told other levels of noise or have another flow."""
        self._batch = other._batch
        self._begin(other.estimate.reshape(-1, self._flow.nx), other._P * other._units)
        self._mean_square = other._mean_square.copy()

    def ahead(self, u: np.ndarray) -> Gaussian:
        """Scaled estimates and covariances a sample later, under inputs (..., nu), before that sample is known."""
        flow = self._flow
        points = 2 * flow.nx + 1
        v = np.tile(u.reshape(len(self._x), flow.nu) / flow.u_scale, (points, 1))

        def move(s: np.ndarray) -> np.ndarray:
            return flow.scaled(np.clip(s, self._low, self._high).reshape(-1, flow.nx), v).reshape(s.shape)

        with np.errstate(over="ignore", invalid="ignore"):
            return predicted(self._x, self._P, move=move, Q=self._Q)

    def expected(self, ahead: Gaussian) -> np.ndarray:
        """The outputs (..., ny) that belong to it."""
        return self._output(ahead[0]).reshape(*self._batch, -1)

    def correct(self, ahead: Gaussian, y: np.ndarray, rows: np.ndarray | None = None) -> None:
        """Take in samples (..., ny), NaN where they are missing, in all rows or some (...,)."""
        y = y.reshape(len(self._x), -1)
        with np.errstate(over="ignore", invalid="ignore"):
            x, P, nis = corrected(*ahead, y, output=self._output, R=self._R)
        mean_square = self._mean_square + self._share * ~np.isnan(y).all(-1) * (nis - self._mean_square)
        broken = ~(np.isfinite(P).all((1, 2)) & np.isfinite(x).all(-1))
        if broken.any():
            mean_square[broken] = np.inf
            x[broken], P[broken] = self._x[broken], self._P[broken]
        x = np.clip(x, self._low, self._high)
        if rows is not None:
            rows = rows.ravel()
            x, P = np.where(rows[:, None], x, self._x), np.where(rows[:, None, None], P, self._P)
            mean_square = np.where(rows, mean_square, self._mean_square)
        self._x, self._P, self._mean_square = x, P, mean_square

    def supervise(self, z: np.ndarray, age: np.ndarray | float, rows: np.ndarray | None = None) -> None:
        """Let T_inv say where it is to, of z, (..., size), at ages in samples, in all rows or some (...,)."""
        age = np.broadcast_to(age, self._batch).ravel()
        lost, asked = ~(self._mean_square <= self._limit), age < self._window  # lost where it is NaN too
        if rows is not None:
            lost, asked = lost & rows.ravel(), asked & rows.ravel()
        where = np.flatnonzero(lost | asked)
        if not len(where):
            return
        lost = lost[where]
        x, P = self._scaled(*self._said(z.reshape(-1, z.shape[-1])[where], age[where], lost))
        taken = lost | (_mean_square(P) < _mean_square(self._P[where]))
        if taken.any():
            self._own()
            self._x[where[taken]], self._P[where[taken]] = x[taken], P[taken]
            self._mean_square[where[lost]] = 1.0

    def _said(self, z: np.ndarray, age: np.ndarray, lost: np.ndarray | None = None) -> Gaussian:
        """What T_inv says of z, (k, size), at ages in samples: estimates, and covariances, in units of the states."""
        parts, x = self._decoders.estimate(z, age * self._dt)
        P = self._decoders.covariance(parts)
        if lost is not None and lost.any():
            soon = np.minimum(age[lost], self._window) * self._dt
            P[lost] = self._decoders.covariances(z[lost], soon)
        return x, P

    def _begin(self, x: np.ndarray, P: np.ndarray) -> None:
        """Begin with estimates (n, nx) of covariances (n, nx, nx), in units of the states."""
        self._x, self._P = self._scaled(x, P)
        self._mean_square = np.ones(len(x))

    def _output(self, s: np.ndarray) -> np.ndarray:
        return self._artifact.output(self._flow.x_offset + self._flow.x_scale * s)

    def _scaled(self, x: np.ndarray, P: np.ndarray) -> Gaussian:
        s = (x - self._flow.x_offset) / self._flow.x_scale
        return np.clip(s, self._low, self._high), P / self._units

    def _own(self) -> None:
        """Take copies to change: others may look at what there was."""
        self._x, self._P, self._mean_square = self._x.copy(), self._P.copy(), self._mean_square.copy()


def _mean_square(P: np.ndarray) -> np.ndarray:
    """Of errors with covariances (n, nx, nx), summed over the states: (n,).

    Not the determinant: soon after a wrong start the tracker is far too sure along what is measured.
    """
    return np.asarray(np.trace(P, axis1=-2, axis2=-1))


def _largest_mean_square(freedom: float) -> float:
    """Of as many standard normal numbers, beyond chance: by Wilson and Hilferty's cube root of chi-square."""
    spread = 2 / (9 * freedom)
    return float((1 - spread + _BEYOND_CHANCE * math.sqrt(spread)) ** 3)


__all__ = ["Tracker"]
