"""An estimate that goes on with the learned motion of the system, and is corrected by each sample."""

import copy
import functools
import math
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.compiled_tracker import CompiledTracker
from observers.decoder import Decoders
from observers.sparse import MANY_ROWS
from observers.unscented import Gaussian, corrected, predicted

# A filter is lost where innovations are as large as that by chance once in 1e9: the normal distribution's quantile.
_BEYOND_CHANCE = 5.998
KNOWN = 1e-3  # standard deviation of a state that is said to be known, in scaled states
_FIRST, _FLAGS = np.zeros(1, dtype=np.intp), (np.array([False]), np.array([True]))  # the row of a single sample


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
    compiled : bool, default False
        Whether single samples go through machine code, as :class:`observers.KKLObserver` has it. Batches of many rows
        do so wherever Numba is installed, if the output is linear.
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
        flow, self._dt = artifact.require_flow(), artifact.filter.dt
        self._flow, self._artifact, self._decoders, self._singly = flow, artifact, decoders, compiled
        self._variances = q, r = flow.variances(measurement_noise, process_noise)
        self._Q, self._R = np.diag(q), np.diag(r)
        self._low, self._high = ((bound - flow.x_offset) / flow.x_scale for bound in (flow.low, flow.high))
        self._units = flow.x_scale[:, None] * flow.x_scale
        self._window = max(1, round(flow.window / self._dt))
        self._share = -math.expm1(-1 / self._window)
        self._limit = _largest_mean_square(len(r) * (2 - self._share) / self._share)
        shares = artifact.inverse.shares(measurement_noise, process_noise)
        self._log_roots, self._free_log_roots = (  # of factors, by age in samples
            (each.ages / self._dt, each.log_roots(*shares))
            for each in (flow.factors, flow.free_factors or flow.factors)
        )
        self._batch: tuple[int, ...]
        self._x: np.ndarray  # scaled states (n, nx) of the flattened batch
        self._P: np.ndarray
        self._mean_square: np.ndarray

    @property
    def estimate(self) -> np.ndarray:
        """The estimates, (..., nx)."""
        flow = self._flow
        if not self._batch:  # a single sample: every call of numpy would be felt
            return flow.x_offset + flow.x_scale * self._x[0]
        return (flow.x_offset + flow.x_scale * self._x).reshape(*self._batch, flow.nx)

    def covariance(self, z: np.ndarray, age: np.ndarray | float) -> np.ndarray:
        """Covariances of the estimates' errors, (..., nx, nx), beside z, (..., size), at ages in samples."""
        nz = len(self._artifact.filter.A)  # behind it lies z_u, exactly 0 until an input acts
        if not self._batch:  # a single sample: every call of numpy would be felt
            ages, logs = self._log_roots if any(z[nz:].tolist()) else self._free_log_roots
            log = logs[-1] if age >= ages[-1] else np.interp(age, ages, logs)
            return self._P[0] * (self._units * math.exp(2 * log))
        acted = z[..., nz:].any(-1)
        logs = np.where(acted, np.interp(age, *self._log_roots), np.interp(age, *self._free_log_roots))
        factors = np.exp(2 * logs)
        P = self._P * self._units
        return P.reshape(*self._batch, *P.shape[1:]) * factors[..., None, None]

    def reset(self, z: np.ndarray, age: np.ndarray | float, x0: np.ndarray | None = None) -> None:
        """Begin with what T_inv says of z, (..., size), at ages in samples, or with states that are known."""
        self._batch = z.shape[:-1]
        if x0 is not None:
            x = np.reshape(x0, (-1, self._flow.nx)).astype(float)
            self._begin(x, np.broadcast_to(np.diag((KNOWN * self._flow.x_scale) ** 2), (*x.shape, x.shape[-1])))
        elif self._batch:
            self._begin(*self._said(z.reshape(-1, z.shape[-1]), np.broadcast_to(age, self._batch).ravel()))
        else:
            self._begin(*self._said_of_one(z, float(age)))

    def restart(self, rows: np.ndarray, z: np.ndarray, age: float, x0: np.ndarray | None = None) -> None:
        """Begin anew in some rows (...,), with what T_inv says of their z, (k, size), or with their known states."""
        if not rows.any():
            return
        begun, where = copy.copy(self), rows.ravel()
        begun.reset(z, age, x0)
        self._own()
        self._x[where], self._P[where], self._mean_square[where] = begun._x, begun._P, begun._mean_square

    def copied(self) -> "Tracker":
        """Another that stands where this one does, and goes its own way."""
        other = copy.copy(self)
        other._own()
        return other

    def go_on(self, other: "Tracker") -> None:
        """Go on where another stands, which may be told other levels of noise or have another flow."""
        self._batch = other._batch
        self._begin(other.estimate.reshape(-1, self._flow.nx), other._P * other._units)
        self._mean_square = other._mean_square.copy()

    def warm_up(self, z: np.ndarray) -> None:
        """Make the machine code for single samples now, by one of z, (size,), that is forgotten."""
        one = copy.copy(self)
        one.reset(z, 0)
        one.correct(one.ahead(np.zeros(self._flow.nu)), np.zeros(len(self._R)))
        one.supervise(z, 0)

    def ahead(self, u: np.ndarray) -> Gaussian:
        """Scaled estimates and covariances a sample later, under inputs (..., nu), before that sample is known."""
        flow, n = self._flow, len(self._x)
        if self._machine is not None:
            return self._machine.ahead(self._state, u.copy().reshape(n, flow.nu))  # the user's own may be read-only
        v = np.concatenate([u.reshape(n, flow.nu) / flow.u_scale] * (2 * flow.nx + 1))

        def move(s: np.ndarray) -> np.ndarray:
            return flow.scaled(s.clip(self._low, self._high).reshape(-1, flow.nx), v).reshape(s.shape)

        with np.errstate(over="ignore", invalid="ignore"):
            return predicted(self._x, self._P, move=move, Q=self._Q)

    def expected(self, ahead: Gaussian) -> np.ndarray:
        """The outputs (..., ny) that belong to it."""
        return self._output(ahead[0]).reshape(*self._batch, len(self._R))

    def correct(self, ahead: Gaussian, y: np.ndarray, rows: np.ndarray | None = None) -> None:
        """Take in samples (..., ny), NaN where they are missing, in all rows or some (...,)."""
        y = y.reshape(len(self._x), len(self._R))
        if self._machine is not None:
            self._machine.correct(ahead, y, None if rows is None else rows.flatten(), self._state)
            return
        with np.errstate(over="ignore", invalid="ignore"):
            x, P, nis = corrected(*ahead, y, output=self._output, R=self._R)
            sound = math.isfinite(x.sum() + P.sum())  # all of them, most often
        mean_square = self._mean_square + self._share * ~np.isnan(y).all(-1) * (nis - self._mean_square)
        if not sound:
            broken = ~(np.isfinite(P).all((1, 2)) & np.isfinite(x).all(-1))
            mean_square[broken] = np.inf
            x[broken], P[broken] = self._x[broken], self._P[broken]
        x = x.clip(self._low, self._high)
        if rows is not None:
            rows = rows.ravel()
            x, P = np.where(rows[:, None], x, self._x), np.where(rows[:, None, None], P, self._P)
            mean_square = np.where(rows, mean_square, self._mean_square)
        self._x, self._P, self._mean_square = x, P, mean_square

    def supervise(self, z: np.ndarray, age: np.ndarray | float, rows: np.ndarray | None = None) -> None:
        """Let T_inv say where it is to, of z, (..., size), at ages in samples, in all rows or some (...,)."""
        if not self._batch:  # a single sample: every call of numpy would be felt
            age, one = float(age), not self._mean_square[0] <= self._limit  # lost where it is NaN too
            if (one or age < self._window) and (rows is None or rows):
                self._take(self._said_of_one(z, age, one), _FLAGS[one], _FIRST)
            return
        age = np.broadcast_to(age, self._batch).ravel()
        lost, asked = ~(self._mean_square <= self._limit), age < self._window
        if rows is not None:
            lost, asked = lost & rows.ravel(), asked & rows.ravel()
        where = np.flatnonzero(lost | asked)
        if not len(where):
            return
        z = z.reshape(-1, z.shape[-1])
        if len(where) < len(z):
            z, age, lost = z[where], age[where], lost[where]
        self._take(self._said(z, age, lost), lost, where)

    def _take(self, said: Gaussian, lost: np.ndarray, where: np.ndarray) -> None:
        """Take what T_inv says of some rows, (k,), where it is surer or the tracker is lost."""
        if self._machine is not None:
            self._machine.take(said, lost, where, self._state)
            return
        x, P = self._scaled(*said)
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

    def _said_of_one(self, z: np.ndarray, age: float, lost: bool = False) -> Gaussian:
        """The same of a single sample, (size,); still with an axis of rows."""
        parts, x = self._decoders.estimate(z, age * self._dt, both=not lost)
        if lost:
            return x[None], self._decoders.covariances(z, min(age, self._window) * self._dt)[None]
        return x[None], self._decoders.covariance(parts)[None]

    def _begin(self, x: np.ndarray, P: np.ndarray) -> None:
        """Begin with estimates (n, nx) of covariances (n, nx, nx), in units of the states."""
        self._x, self._P = map(np.ascontiguousarray, self._scaled(x, P))
        self._mean_square = np.ones(len(x))

    def _output(self, s: np.ndarray) -> np.ndarray:
        return self._artifact.output(self._flow.x_offset + self._flow.x_scale * s)

    def _scaled(self, x: np.ndarray, P: np.ndarray) -> Gaussian:
        s = (x - self._flow.x_offset) / self._flow.x_scale
        return s.clip(self._low, self._high), P / self._units

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_compiled"}  # Numba is not everywhere

    @property
    def _state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._x, self._P, self._mean_square

    @property
    def _machine(self) -> CompiledTracker | None:
        """What takes NumPy's place for as many rows as there are, None where nothing does."""
        return self._compiled if len(self._x) >= MANY_ROWS or (self._singly and not self._batch) else None

    @functools.cached_property
    def _compiled(self) -> CompiledTracker | None:
        C = self._artifact.C
        if C is None:
            return None
        try:
            return CompiledTracker(self._flow, C, variances=self._variances, share=self._share)
        except ImportError:
            return None

    def _own(self) -> None:
        """Take copies to change: others may look at what there was."""
        self._x, self._P, self._mean_square = (part.copy() for part in self._state)


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
