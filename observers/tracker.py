"""An estimate that goes on with the learned motion of the system, and is corrected by each sample."""

import copy
import functools
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.compiled_tracker import CompiledTracker
from observers.decoder import Decoders
from observers.factors import Factors
from observers.supervision import INFLATION, Supervision
from observers.thresholds import MANY_ROWS
from observers.unscented import Gaussian, conditioned, predicted, transformed

KNOWN = 1e-3  # standard deviation of a state that is said to be known, in scaled states
KEPT = 4096  # of what scales single covariances, which else grows by one with each sample of short dt
_FIRST, _FLAGS = np.zeros(1, dtype=np.intp), (np.array([False]), np.array([True]))  # the row of a single sample


class _Calibrated:
    """What covariances of scaled states become at levels of noise, by the age in samples."""

    def __init__(self, factors: Factors, shares: tuple[float, float], dt: float, units: np.ndarray) -> None:
        self._ages, self._logs, self._doubts = factors.ages / dt, factors.log_roots(*shares), factors.doubts(*shares)
        self._parts = np.array([units * np.eye(len(units)), units * (1.0 - np.eye(len(units)))])  # along, and across
        self.last = float(self._ages[-1])  # after which nothing changes
        self._scales = dict[tuple[float, float], np.ndarray]()  # of single samples, for which all this takes too long

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_scales": {}}

    def at(self, age: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Factors and doubts, (n,)."""
        return np.exp(2 * np.interp(age, self._ages, self._logs)), np.interp(age, self._ages, self._doubts)

    def within(self, seen: np.ndarray, age: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The larger ones of those after so many samples and at that age, between which some were missing."""
        if (seen == age).all():
            return self.at(age)
        (factor, doubt), (factor_at, doubt_at) = self.at(seen), self.at(age)
        return np.maximum(factor, factor_at), np.maximum(doubt, doubt_at)

    def scales(self, factor: np.ndarray, doubt: np.ndarray) -> np.ndarray:
        """What is multiplied with covariances (n, nx, nx) where T_inv is not asked, entry by entry."""
        weights = np.column_stack([factor, factor * (1.0 - doubt)])
        return np.asarray(weights @ self._parts.reshape(2, -1)).reshape(-1, *self._parts.shape[1:])

    def scale(self, seen: float, age: float) -> np.ndarray:
        """The same of a single sample, (nx, nx)."""
        key = seen, age = min(seen, self.last), min(age, self.last)
        scale = self._scales.get(key)
        if scale is None:
            if len(self._scales) == KEPT:
                self._scales.clear()
            scale = self._scales[key] = self.scales(*self.within(np.array([seen]), np.array([age])))[0]
        return scale

    @functools.cached_property
    def last_scale(self) -> np.ndarray:
        """The same from the last age on."""
        return self.scale(self.last, self.last)


class Tracker:
    """An unscented Kalman filter on a learned flow, for a batch of rows.

    It is as good as its flow once it is near the state, and cannot find it: that is what T_inv is for. T_inv says where
    to begin. Within the flow's window from there it says so again where it is surer, by the traces of both covariances
    of scaled states. (Asked for longer, it is surer by chance now and then, and errors rise.) It also says so where the
    tracker is lost: where the mean square of its innovations, over the window, is beyond chance for the levels of noise
    told, or its covariance is none any more. What came before may then have misled z too, so that T_inv is taken for no
    surer than so soon after a reset as the window is long.

    Windows are of samples that were there. While they are missing z forgets its start as it does else, which the
    estimate of T_inv has to be told, but learns nothing: T_inv is then not asked, and later no surer than after those
    that were there.

    An estimate that is off by less than the noise is not lost, and may be off by many times what the filter believes.
    Its innovations then agree with one another. Where the mean square of their running mean is beyond chance, the
    filter's covariance is inflated tenfold, so that it believes the samples again.

    What it says of its own errors is not the filter's covariance P alone, which is now and then far too small. P is
    doubted, at each level of noise and age as far as that made errors likelier in calibration: (1 - doubt) P + doubt M.
    Within the window M is what T_inv says of these errors. That is its own covariance, and the square of what the two
    estimates differ by. Later T_inv is not asked, and M is the diagonal of P: a filter on a motion that contracts is
    too sure of what it takes to go together. A factor then makes regions hold what they should.
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
        self._low, self._high = flow.scaled_bounds
        self._nz = len(artifact.filter.A)
        self._C = None if artifact.C is None else artifact.C * flow.x_scale
        self._units = flow.x_scale[:, None] * flow.x_scale
        self._supervision = Supervision.of(flow, self._dt)
        self._window = self._supervision.window
        self._end = flow.nx + flow.nx**2  # of what a row of the state says of the estimate
        shares = artifact.inverse.shares(measurement_noise, process_noise)
        self._calibrated, self._free_calibrated = (
            _Calibrated(each, shares, self._dt, self._units)
            for each in (flow.factors, flow.free_factors or flow.factors)
        )
        self._batch: tuple[int, ...]
        self._state: np.ndarray  # a row for each of the flattened batch: what the six properties below say
        self._known: np.ndarray  # whether it began at a known state, (n,): T_inv then has nothing to say of errors
        self._shown: np.ndarray | None = None  # the estimates, (n, nx) or (nx,), where machine code has made them
        self._heard: tuple[np.ndarray, np.ndarray, Gaussian] | None = None  # z, rows (n,), what T_inv said of these
        self._looked_at: tuple[Any, Any] = None, None  # a state of one row, and its covariance, a view of that

    @property
    def _x(self) -> np.ndarray:
        """Scaled states, (n, nx)."""
        return self._state[:, : self._flow.nx]

    @property
    def _P(self) -> np.ndarray:
        """Their covariances, (n, nx, nx)."""
        nx = self._flow.nx
        return self._state[:, nx : self._end].reshape(len(self._state), nx, nx)

    @property
    def _mean_square(self) -> np.ndarray:
        """Of the innovations, over the window, (n,)."""
        return self._state[:, self._end]

    @property
    def _trend_square(self) -> np.ndarray:
        """The mean square of the trend over four windows, (n,), 1 where innovations are independent."""
        return self._state[:, self._end + 1]

    @property
    def _seen(self) -> np.ndarray:
        """Samples since the beginning of which anything was there, (n,)."""
        return self._state[:, self._end + 2]

    @property
    def _trend(self) -> np.ndarray:
        """The running mean of the innovations, in units of their standard deviations, (n, ny)."""
        return self._state[:, self._end + 3 :]

    @property
    def estimate(self) -> np.ndarray:
        """The estimates, (..., nx)."""
        flow = self._flow
        if self._shown is not None:
            return self._shown.copy().reshape(*self._batch, flow.nx) if self._batch else self._shown.copy()
        if not self._batch:  # a single sample: every call of numpy would be felt
            x: np.ndarray = self._state[0, : flow.nx] * flow.x_scale
            x += flow.x_offset
            return x
        return (flow.x_offset + flow.x_scale * self._x).reshape(*self._batch, flow.nx)

    def covariance(self, z: np.ndarray, age: np.ndarray | float) -> np.ndarray:
        """Covariances of the estimates' errors, (..., nx, nx), beside z, (..., size), at ages in samples."""
        nz = self._nz  # behind it lies z_u, exactly 0 until an input acts
        if not self._batch:  # a single sample: every call of numpy would be felt
            acted = len(z) > nz and (z.item(nz) != 0.0 or any(z[nz:].tolist()))
            calibrated = self._calibrated if acted else self._free_calibrated
            seen = self._state.item(self._end + 2)
            if seen >= self._window or self._known.item(0):
                state, P = self._looked_at
                if state is not self._state:
                    state, P = self._looked_at = self._state, self._P[0]
                scale = calibrated.last_scale if seen >= calibrated.last else calibrated.scale(seen, float(age))
                single: np.ndarray = P * scale
                return single
            heard = self._heard
            said = heard[2] if heard is not None and heard[0] is z else self._said_of_one(z, float(age), seen)
            return self._soon(said, *calibrated.within(np.array([seen]), np.array([age])))[0]
        heard, n, nx = self._heard, len(self._state), self._flow.nx
        heard = heard if heard is not None and heard[0] is z else None
        z = z.reshape(n, z.shape[-1])
        ages, acted, seen = np.ravel(np.asarray(age, dtype=float)), _acted(z[:, nz:]), self._seen
        P = (self._state[:, nx : self._end] * self._scales(seen, ages, acted)).reshape(n, nx, nx)
        soon = (seen < self._window) & ~self._known
        if soon.any():
            ages = np.broadcast_to(ages, n)[soon]
            if heard is not None and heard[1][soon].all():
                _, asked, (x, covariance) = heard
                said = x[soon[asked]], covariance[soon[asked]]
            else:
                said = self._said(z[soon], ages, seen[soon])
            P[soon] = self._soon(said, *self._factors(seen[soon], ages, acted[soon]), soon)
        return P.reshape(*self._batch, nx, nx)

    def _factors(self, seen: np.ndarray, age: np.ndarray, acted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Factors and doubts, (n,), after so many samples, at ages; of rows on which an input has acted, and others."""
        factor, doubt = self._calibrated.within(seen, age)
        if not acted.all():
            factor[~acted], doubt[~acted] = self._free_calibrated.within(seen[~acted], age[~acted])
        return factor, doubt

    def _scales(self, seen: np.ndarray, age: np.ndarray, acted: np.ndarray) -> np.ndarray:
        """What is multiplied with covariances where T_inv is not asked, (n, nx^2), or of all rows (1, nx^2).

        Ages are those of all rows, (n,), or the one that they share, (1,).
        """
        both = self._calibrated, self._free_calibrated
        last = max(each.last for each in both)
        late = seen.min(initial=np.inf) >= last
        if late or (len(age) == 1 and (seen == age).all()):  # most often
            one = last if late else age.item(0)
            driven, free = (each.scale(one, one).reshape(1, -1) for each in both)
            return driven if acted.all() else free if not acted.any() else np.where(acted[:, None], driven, free)
        age = np.broadcast_to(age, seen.shape)
        return self._calibrated.scales(*self._factors(seen, age, acted)).reshape(len(seen), len(self._units) ** 2)

    def _soon(
        self, said: Gaussian, factor: np.ndarray, doubt: np.ndarray, rows: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """Covariances within the window, (k, nx, nx), beside what T_inv says."""
        x, covariance = said
        apart = x - (self._flow.x_offset + self._flow.x_scale * self._x[rows])
        P = self._P[rows] * self._units
        P += doubt[:, None, None] * (covariance + apart[:, :, None] * apart[:, None, :] - P)
        P *= factor[:, None, None]
        return P

    def reset(self, z: np.ndarray, age: np.ndarray | float, x0: np.ndarray | None = None) -> None:
        """Begin with what T_inv says of z, (..., size), at ages in samples, or with states that are known."""
        self._batch = z.shape[:-1]
        if x0 is not None:
            x = np.reshape(x0, (-1, self._flow.nx))
            P = np.broadcast_to(np.diag((KNOWN * self._flow.x_scale) ** 2), (*x.shape, x.shape[-1]))
            self._begin(x, P, float(age))
        elif self._batch:
            ages = np.broadcast_to(age, self._batch).ravel()
            self._begin(*self._said(z.reshape(-1, z.shape[-1]), ages, ages), ages)
        else:
            self._begin(*self._said_of_one(z, float(age), float(age)), float(age))
        self._known = np.full(len(self._state), x0 is not None)

    def restart(self, rows: np.ndarray, z: np.ndarray, age: float, x0: np.ndarray | None = None) -> None:
        """Begin anew in some rows (...,), with what T_inv says of their z, (k, size), or with their known states."""
        if not rows.any():
            return
        begun, where = copy.copy(self), rows.ravel()
        begun.reset(z, age, x0)
        self._shown, self._state = None, self._state.copy()  # others may look at what there was
        self._state[where] = begun._state
        self._known = self._known.copy()
        self._known[where] = begun._known

    def __copy__(self) -> "Tracker":
        """Another that looks at the same; not by pickling, which would lose the machine code."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def copied(self) -> "Tracker":
        """Another that stands where this one does, and goes its own way."""
        other = copy.copy(self)
        other._state, other._shown = self._state.copy(), None
        return other

    def go_on(self, other: "Tracker") -> None:
        """Go on where another stands, which may be told other levels of noise or have another flow."""
        self._batch = other._batch
        self._begin(other.estimate.reshape(-1, self._flow.nx), other._P * other._units, other._seen)
        self._state[:, self._end :] = other._state[:, other._end :]
        self._known = other._known

    def warm_up(self, z: np.ndarray) -> None:
        """Make the machine code for single samples now, by one of z, (size,), that is forgotten."""
        if self._compiled is None:
            return
        one = copy.copy(self)
        one.reset(z, 0)
        y = np.zeros(len(self._R))
        one.step_single(z, y, np.zeros(self._flow.nu), y)
        one.supervise(z, 0)

    def advance(self, y: np.ndarray, u: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Go on under inputs (..., nu), and take in samples (..., ny), NaN where they are missing, in all rows or some.

        Returns the outputs that were expected, (..., ny), which are not finite where a covariance broke down.
        """
        n, ny = len(self._state), len(self._R)
        self._shown, y, rows = None, y.reshape(n, ny), None if rows is None else rows.flatten()
        machine = self._machine if self._batch else None
        if machine is not None:
            inputs = u.copy().reshape(n, self._flow.nu)  # the user's own may be read-only
            self._shown, expected = machine.advance(self._state, inputs, y, rows)
            return expected.reshape(*self._batch, ny)
        with np.errstate(over="ignore", invalid="ignore"):
            x, P = self._ahead(u)
            if self._C is None:
                expected, S, across = transformed(x, P, function=self._output)
            else:
                expected, across = self._output(x), P @ self._C.T
                S = self._C @ across
            missing = np.isnan(y)  # and not where h is undefined, which breaks an estimate down
            x, P, white = conditioned(x, P, y - expected, S + self._R, across, missing)
            P, watched = self._watched(P, white, ~missing)
            state = self._packed(self._within(x), P, watched)
            sound = np.isfinite(state[:, : self._end].sum(-1))
        taken = sound if rows is None else sound & rows
        if not taken.all():
            state = np.where(taken[:, None], state, self._state)
            state[~sound if rows is None else ~sound & rows, self._end] = np.inf
        self._state = state
        return expected.reshape(*self._batch, ny)

    def _watched(self, P: np.ndarray, white: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Covariances, and the rows' ends (n, 3 + ny), after innovations (n, ny) in units of standard deviations.

        A covariance is inflated where they agree with one another.
        """
        watch, count = self._supervision, seen.sum(-1)
        counted = count / seen.shape[1]  # less of those that are known in part, which scatter more
        seen_mean = 1 / np.maximum(count, 1)
        mean_square = self._mean_square + watch.share * counted * (seen_mean * (white**2).sum(-1) - self._mean_square)
        trend = self._trend + watch.trend_share * np.where(seen, white - self._trend, 0.0)
        square = watch.trend_gain * seen_mean * (np.where(seen, trend, 0.0) ** 2).sum(-1)
        trend_square = self._trend_square + watch.trend_square_share * counted * (square - self._trend_square)
        agree = (trend_square > watch.trend_limit) & (count > 0)
        if agree.any():
            P = np.where(agree[:, None, None], INFLATION * P, P)
            trend_square, trend = np.where(agree, 1.0, trend_square), np.where(agree[:, None], 0.0, trend)
        return P, np.column_stack([mean_square, trend_square, self._seen + (count > 0), trend])

    def step_single(
        self, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """As :meth:`advance` for a single sample by machine code, which takes the filter's state z along.

        Returns the next z, (size,), and the sample, (ny,), with what was expected in place of what is missing. None
        where this is left to NumPy, and nothing has happened.
        """
        if self._batch or not self._singly or self._compiled is None:
            return None
        u = u.copy()  # the user's own: to Numba, an array that is read-only or has strides is of another type
        self._shown, y_next, z = self._compiled.single(self._state, z, y, u, y_next)
        return z, y_next

    def _ahead(self, u: np.ndarray) -> Gaussian:
        """Scaled estimates and covariances a sample later, before that sample is known."""
        flow = self._flow
        v = u.reshape(len(self._state), flow.nu) / flow.u_scale

        def move(s: np.ndarray) -> np.ndarray:
            return flow.scaled(self._within(s), v)

        x, P = predicted(self._x, self._P, move=move, Q=self._Q)
        if flow.bend is not None:
            moved = ((x - self._x) ** 2).sum(-1)
            P = P + (flow.bend * moved[:, None])[:, :, None] ** 2 * np.eye(flow.nx)
        return x, P

    def supervise(
        self,
        z: np.ndarray,
        age: np.ndarray | float,
        rows: np.ndarray | None = None,
        seen: np.ndarray | np.bool_ | bool = True,
    ) -> None:
        """Let T_inv say where it is to, of z, (..., size), at ages in samples, in all rows or some (...,).

        ``seen`` is where anything of the last sample was there, in all rows or (...,).
        """
        self._heard = None
        if not self._batch:  # a single sample: every call of numpy would be felt
            one = not self._state.item(self._end) <= self._supervision.limit  # lost where it is NaN too
            count = self._state.item(self._end + 2)
            if (one or (seen and count < self._window)) and (rows is None or rows):
                said = self._said_of_one(z, float(age), min(count, self._window), one)
                self._take(said, _FLAGS[one], _FIRST)
                self._heard = z, _FLAGS[True], said
            return
        lost = ~(self._mean_square <= self._supervision.limit)
        count = self._seen
        asked = count < self._window if seen is True else (count < self._window) & np.ravel(seen)
        if not asked.any() and not lost.any():  # most often
            return
        age = np.broadcast_to(age, self._batch).ravel()
        if rows is not None:
            lost, asked = lost & rows.ravel(), asked & rows.ravel()
        asked = asked | lost
        where = np.flatnonzero(asked)
        if not len(where):
            return
        flat = z.reshape(-1, z.shape[-1])
        if len(where) < len(flat):
            flat, age, lost, count = flat[where], age[where], lost[where], count[where]
        said = self._said(flat, age, np.minimum(count, self._window), lost)
        self._take(said, lost, where)
        self._heard = z, asked, said

    def _take(self, said: Gaussian, lost: np.ndarray, where: np.ndarray) -> None:
        """Take what T_inv says of some rows, (k,), where it is surer or the tracker is lost."""
        if not self._batch:
            self._shown = None
        if self._machine is not None:
            self._machine.take(said, lost, where, self._state, self._shown)
            return
        self._shown = None
        x, P = self._scaled(*said)
        taken = lost | (_mean_square(P) < _mean_square(self._P[where]))
        if taken.any():
            self._state = self._state.copy()  # others may look at what there was
            self._x[where[taken]], self._P[where[taken]] = x[taken], P[taken]
            self._mean_square[where[lost]] = self._trend_square[where[lost]] = 1.0
            self._trend[where[lost]] = 0.0

    def _said(self, z: np.ndarray, age: np.ndarray, learned: np.ndarray, lost: np.ndarray | None = None) -> Gaussian:
        """What T_inv says of z, (k, size), at ages in samples: estimates, and covariances, in units of the states.

        It is as sure of them as of z that had learned of so many samples, (k,), and forgotten its start for as long.
        Of lost rows that is always asked by itself, on which the last digits of published results rest.
        """
        parts, x = self._decoders.estimate(z, age * self._dt)
        less = learned < age if lost is None else lost | (learned < age)
        if less.all():
            return x, self._decoders.covariances(z, learned * self._dt)
        P = self._decoders.covariance(parts)
        if less.any():
            P[less] = self._decoders.covariances(z[less], learned[less] * self._dt)
        return x, P

    def _said_of_one(self, z: np.ndarray, age: float, learned: float, lost: bool = False) -> Gaussian:
        """The same of a single sample, (size,); still with an axis of rows."""
        less = lost or learned < age
        parts, x = self._decoders.estimate(z, age * self._dt, both=not less)
        if less:
            return x[None], self._decoders.covariances(z, learned * self._dt)[None]
        return x[None], self._decoders.covariance(parts)[None]

    def _begin(self, x: np.ndarray, P: np.ndarray, seen: np.ndarray | float) -> None:
        """Begin with estimates (n, nx) of covariances (n, nx, nx), in units of the states, after so many samples."""
        watched = np.tile([1.0, 1.0, 0.0, *np.zeros(len(self._R))], (len(x), 1))
        watched[:, 2] = seen
        self._shown, self._heard = None, None
        self._state = self._packed(*self._scaled(x, P), watched)

    def _packed(self, x: np.ndarray, P: np.ndarray, watched: np.ndarray) -> np.ndarray:
        return np.concatenate([x, P.reshape(len(x), x.shape[1] ** 2), watched], axis=1)

    def _output(self, s: np.ndarray) -> np.ndarray:
        y = self._artifact.output(self._flow.x_offset + self._flow.x_scale * s)
        if s.ndim == 3 and not np.isfinite(y).all():  # sigma points may lie beyond the motion, where h is undefined
            for nearer in (self._within(s), s.mean(0, keepdims=True)):
                there = self._artifact.output(self._flow.x_offset + self._flow.x_scale * nearer)
                y = np.where(np.isfinite(y), y, there)
        return y

    def _scaled(self, x: np.ndarray, P: np.ndarray) -> Gaussian:
        s = (x - self._flow.x_offset) / self._flow.x_scale
        return self._within(s), P / self._units

    def _within(self, s: np.ndarray) -> np.ndarray:
        """Scaled states cut at the bounds; ndarray.clip takes several times as long for a single sample."""
        return np.minimum(np.maximum(s, self._low), self._high)

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in self.__dict__.items() if name != "_compiled"}  # Numba is not everywhere
        return {**state, "_looked_at": (None, None)}  # a copy of a view is none

    @property
    def _machine(self) -> CompiledTracker | None:
        """What takes NumPy's place for as many rows as there are, None where nothing does."""
        return self._compiled if len(self._state) >= MANY_ROWS or (self._singly and not self._batch) else None

    @functools.cached_property
    def _compiled(self) -> CompiledTracker | None:
        C = self._artifact.C
        if C is None:
            return None
        try:
            return CompiledTracker(self._flow, self._artifact.filter, C, self._supervision, variances=self._variances)
        except ImportError:
            return None


def _acted(z_u: np.ndarray) -> np.ndarray:
    """Whether an input has acted, (n,), by the filter's states of inputs (n, size): mostly the first column tells."""
    acted = np.asarray(z_u[:, :1].any(-1))
    if not acted.all():
        acted[~acted] = z_u[~acted].any(-1)
    return acted


def _mean_square(P: np.ndarray) -> np.ndarray:
    """Of errors with covariances (n, nx, nx), summed over the states: (n,).

    Not the determinant: soon after a wrong start the tracker is far too sure along what is measured.
    """
    return np.asarray(np.trace(P, axis1=-2, axis2=-1))


__all__ = ["Tracker"]
