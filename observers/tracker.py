"""An estimate that goes on with the learned motion of the system, and is corrected by each sample."""

import math

import numpy as np

from observers.artifact import Artifact
from observers.unscented import Gaussian, corrected, factor, predicted

# A filter is lost where innovations are as large as that by chance once in 1e9: the normal distribution's quantile.
_BEYOND_CHANCE = 5.998
KNOWN = 1e-3  # standard deviation of a state that is said to be known, in scaled states


class Tracker:
    """An unscented Kalman filter on a learned flow, for a batch of rows.

    It is as good as its flow once it is near the state, and cannot find it: that is what T_inv is for, which says where
    to begin, and again where the filter is lost. It is lost where the mean square of its innovations, over the flow's
    window, is beyond chance for the levels of noise told, or its covariance is none any more.

    Parameters
    ----------
    artifact : Artifact
        With a flow and the output h(x).
    measurement_noise : float or tuple of float, length ny
        Standard deviations of the noise on the samples, of all outputs or each.
    process_noise : float
        Level in multiples of the system's scale per second.
    """

    def __init__(
        self, artifact: Artifact, *, measurement_noise: float | tuple[float, ...], process_noise: float
    ) -> None:
        flow, dt = artifact.require_flow(), artifact.filter.dt
        self._flow, self._artifact = flow, artifact
        q, r = flow.variances(measurement_noise, process_noise)
        self._Q, self._R = np.diag(q), np.diag(r)
        self._low, self._high = ((bound - flow.x_offset) / flow.x_scale for bound in (flow.low, flow.high))
        self._units = flow.x_scale[:, None] * flow.x_scale
        self.window = flow.samples(dt)
        self._share = -math.expm1(-1 / self.window)
        self._limit = _largest_mean_square(len(r) * (2 - self._share) / self._share)
        shares = artifact.inverse.shares(measurement_noise, process_noise)
        self._ages, self._log_roots = flow.factors.ages / dt, flow.factors.log_roots(*shares)
        self._x = np.zeros((0, flow.nx))  # scaled states
        self._P = np.zeros((0, flow.nx, flow.nx))
        self._mean_square = np.zeros(0)

    @property
    def estimate(self) -> np.ndarray:
        """The estimates, (n, nx)."""
        return self._flow.x_offset + self._flow.x_scale * self._x

    def covariance(self, age: np.ndarray | float) -> np.ndarray:
        """Covariances of the estimates' errors, (n, nx, nx), at ages in samples."""
        factors = np.exp(2 * np.interp(age, self._ages, self._log_roots))
        return self._P * self._units * np.reshape(factors, (-1, 1, 1))

    @property
    def lost(self) -> np.ndarray:
        """Which rows T_inv is to say, (n,)."""
        return ~(self._mean_square <= self._limit)  # true of NaN too

    def begin(self, x: np.ndarray, P: np.ndarray) -> None:
        """Forget all rows, and begin with estimates (n, nx) of covariances (n, nx, nx)."""
        self._x, self._P = self._scaled(x, P)
        self._mean_square = np.ones(len(x))

    def know(self, x: np.ndarray) -> None:
        """Begin with states (n, nx) that are known."""
        self.begin(x, np.broadcast_to(np.diag((KNOWN * self._flow.x_scale) ** 2), (*x.shape, x.shape[-1])))

    def take(self, rows: np.ndarray, other: "Tracker") -> None:
        """Take the rows (n,) of another tracker, which holds no others."""
        self._own()
        self._x[rows], self._P[rows], self._mean_square[rows] = other._x, other._P, other._mean_square

    def go_on(self, other: "Tracker") -> None:
        """Go on where another stands, which may be told other levels of noise or have another flow."""
        self.begin(other.estimate, other._P * other._units)
        self._mean_square = other._mean_square.copy()

    def replace(self, rows: np.ndarray, x: np.ndarray, P: np.ndarray) -> None:
        """Take estimates (k, nx) of covariances (k, nx, nx) in some rows (n,), where they are surer or the row is lost.

        What is surer has the smaller determinant.
        """
        x, P = self._scaled(x, P)
        lost, mine = self.lost[rows], self._P[rows]
        with np.errstate(invalid="ignore", divide="ignore"):
            taken = lost | (_log_volume(P) < _log_volume(mine))
        if not taken.any():
            return
        where = np.flatnonzero(rows)[taken]
        self._own()
        self._x[where], self._P[where] = x[taken], P[taken]
        self._mean_square[np.flatnonzero(rows)[lost]] = 1.0

    def ahead(self, u: np.ndarray) -> Gaussian:
        """Scaled estimates and covariances a sample later, under inputs (n, nu), before that sample is known."""
        flow = self._flow
        v = np.broadcast_to(u / flow.u_scale, (2 * flow.nx + 1, len(u), flow.nu)) if flow.nu else None

        def move(points: np.ndarray) -> np.ndarray:
            inside = np.clip(points, self._low, self._high)
            rows = inside.reshape(-1, flow.nx)
            held = np.zeros((len(rows), 0)) if v is None else v.reshape(-1, flow.nu)
            return flow.scaled(rows, held).reshape(points.shape)

        with np.errstate(over="ignore", invalid="ignore"):
            return predicted(self._x, self._P, move=move, Q=self._Q)

    def expected(self, ahead: Gaussian) -> np.ndarray:
        """The outputs (n, ny) that belong to it."""
        return self._output(ahead[0])

    def correct(self, ahead: Gaussian, y: np.ndarray, rows: np.ndarray | None = None) -> None:
        """Take in samples (n, ny), NaN where they are missing, in all rows or some (n,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            x, P, nis = corrected(*ahead, y, output=self._output, R=self._R)
        seen = ~np.isnan(y).all(-1)
        mean_square = np.where(seen, self._mean_square + self._share * (nis - self._mean_square), self._mean_square)
        broken = ~(np.isfinite(P).all((1, 2)) & np.isfinite(x).all(-1))
        if broken.any():
            mean_square[broken] = np.inf
            x[broken], P[broken] = self._x[broken], self._P[broken]
        x = np.clip(x, self._low, self._high)
        if rows is not None:
            x, P = np.where(rows[:, None], x, self._x), np.where(rows[:, None, None], P, self._P)
            mean_square = np.where(rows, mean_square, self._mean_square)
        self._x, self._P, self._mean_square = x, P, mean_square

    def _output(self, s: np.ndarray) -> np.ndarray:
        return self._artifact.output(self._flow.x_offset + self._flow.x_scale * s)

    def _scaled(self, x: np.ndarray, P: np.ndarray) -> Gaussian:
        s = (x - self._flow.x_offset) / self._flow.x_scale
        return np.clip(s, self._low, self._high), P / self._units

    def _own(self) -> None:
        """Take copies to change: others may look at what there was."""
        self._x, self._P, self._mean_square = self._x.copy(), self._P.copy(), self._mean_square.copy()


def _log_volume(P: np.ndarray) -> np.ndarray:
    """Logarithm of the determinant of covariances, halved; NaN of what is none."""
    return np.log(np.diagonal(factor(P), axis1=-2, axis2=-1)).sum(-1)


def _largest_mean_square(freedom: float) -> float:
    """Of as many standard normal numbers, beyond chance: by Wilson and Hilferty's cube root of chi-square."""
    spread = 2 / (9 * freedom)
    return float((1 - spread + _BEYOND_CHANCE * math.sqrt(spread)) ** 3)


__all__ = ["Tracker"]
