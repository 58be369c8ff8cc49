"""The observer that users call: state estimates from samples, one by one or along a record."""

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.checks import bool_array, check_dt, noise_level, noise_levels, real_array
from observers.factors import standard_deviations
from observers.kkl import KKL, Pending
from observers.records import RecordEstimates
from observers.samples import (
    check_arguments,
    check_delay,
    check_gate,
    check_output,
    check_replacement,
    first_state,
    held_input,
)


class KKLObserver(RecordEstimates):
    """z' = A z + B y, x_hat = T_inv(z): a causal state estimate from sampled outputs (Niazi et al., 2025).

    ``x_hat_0 = reset(y_0)``, then ``x_hat_k+1 = step(y_k+1, u_k)`` with u_k the input held over [t_k, t_k+1].
    All calls are batched: outputs of shape (..., ny) give estimates of shape (..., nx). A step is :meth:`advance`,
    which takes the sample, and then :meth:`decode`, which returns the estimate; :meth:`restart` restarts some rows.

    After a reset the filter has a transient. If the state x_0 is known and the artifact holds the forward map T,
    ``reset(y_0, x_0)`` starts at z_0 = T(x_0) without transient. T also gives :attr:`mismatch`, the distance of z from
    T(x_hat).

    If the artifact holds a motion model, the observer tracks: a Kalman filter predicts the estimate by the system's
    equations or a learned :class:`Flow`, and corrects it by each sample (:class:`observers.tracker.Tracker`). T_inv's
    estimate replaces the tracker's after a divergence, and soon after a reset if T_inv's covariance is smaller.

    Parameters
    ----------
    artifact : Artifact
        The learned filter, maps and motion model.
    measurement_noise : float or sequence of float, length ny, optional
        Standard deviation of the noise on each sample: one for all outputs, or one for each if the map takes that.
        By default :attr:`observers.Artifact.measurement_noise`: 0.5 for the maps that ship.
    process_noise : float, optional
        Level of the noise on the state's derivative, in multiples of the system's scale per second, as in environments.
        The tracker takes any level; T_inv limits the level to the largest in its training. By default that largest
        level, which is also the default of the system's environments; 0 if T_inv takes no level.
    monitor : bool, default False
        Whether to test if the samples fit the estimates (see :attr:`score`).
    tracking : bool, optional
        Whether to track. False uses T_inv alone, without any model at run time. None tracks if the artifact holds a
        motion model.
    compiled : bool, optional
        Whether Numba compiles the step (the extra ``fast``). None compiles if Numba is installed, True requires it, and
        False uses NumPy. The first process on a machine compiles for some seconds; later processes read the machine
        code from disk. Numba and NumPy agree to rounding.
    gate : float, optional
        Largest innovation, in multiples of its standard deviation. The observer treats outputs with larger innovations
        as missing; :attr:`rejected` counts them. In the first window (:attr:`Motion.window`, 0.5 s for the maps that
        ship) after a reset without ``x0``, the gate is open. After a divergence or a whole window of rejections it
        opens until the output fits, so estimates follow a lasting jump. A gate needs a map that tracks.
    delay : int, default 0
        Samples by which outputs arrive late. ``step(y, u)`` takes the output of ``delay`` samples ago and the input
        held since the last sample; the motion model then predicts the current state. A delay needs a map that tracks.

    Raises
    ------
    ImportError
        If ``compiled`` is True and Numba is not installed.
    ValueError
        If an argument has the wrong type or is out of range, the levels of measurement noise differ between outputs
        but the map takes one level for all, or the map lacks the motion model or the monitor's limits for an option.
    """

    def __init__(
        self,
        artifact: Artifact,
        measurement_noise: float | Sequence[float] | None = None,
        *,
        process_noise: float | None = None,
        monitor: bool = False,
        tracking: bool | None = None,
        compiled: bool | None = None,
        gate: float | None = None,
        delay: int = 0,
    ) -> None:
        check_arguments(artifact, monitor, compiled, tracking)
        self._gate, self._delay = check_gate(artifact, tracking, gate), check_delay(artifact, tracking, delay)
        self.artifact, self._warned = artifact, frozenset[str]()
        self._options: dict[str, Any] = {"monitor": monitor, "tracking": tracking, "compiled": compiled}
        self._kkl: KKL
        self._state: np.ndarray | None = None  # (n, width), never changed in place
        self._batch: tuple[int, ...] = ()
        self._process_noise = self._level(process_noise)
        self.measurement_noise = artifact.measurement_noise if measurement_noise is None else measurement_noise

    @property
    def measurement_noise(self) -> float | tuple[float, ...]:
        """Assumed standard deviation of the measurement noise, one for all outputs or one for each."""
        return self._measurement_noise

    @measurement_noise.setter
    def measurement_noise(self, levels: float | Sequence[float]) -> None:
        inverse = self.artifact.inverse
        level = noise_levels("measurement_noise", levels, self.artifact.ny)
        if level != (within := inverse.within(level)):
            raise ValueError(
                f"measurement_noise = {level} is beyond the map's range, 0 to {inverse.measurement_noise_max}; "
                f"pass measurement_noise={within}, the nearest level that the map takes"
            )
        self._set_levels(level, self._process_noise)

    @property
    def process_noise(self) -> float:
        """Assumed level of process noise, in multiples of the system's scale per second."""
        return self._process_noise

    @process_noise.setter
    def process_noise(self, level: float | None) -> None:
        self._set_levels(self._measurement_noise, self._level(level))

    @property
    def gate(self) -> float | None:
        """Largest accepted innovation of an output, in multiples of its standard deviation; None accepts any output."""
        return self._gate

    @gate.setter
    def gate(self, gate: float | None) -> None:
        self._gate = check_gate(self.artifact, self._options["tracking"], gate)
        self._set_levels(self._measurement_noise, self._process_noise)

    @property
    def delay(self) -> int:
        """Samples by which outputs arrive late; after a change call :meth:`reset`."""
        return self._delay

    @delay.setter
    def delay(self, delay: int) -> None:
        self._delay, self._state = check_delay(self.artifact, self._options["tracking"], delay), None

    def _level(self, process_noise: float | None) -> float:
        if process_noise is None:
            return self.artifact.process_noise_max or 0.0
        return noise_level("process_noise", process_noise)

    @property
    def tracking(self) -> bool:
        """Whether the observer tracks; otherwise it uses T_inv alone."""
        return self._kkl.tracker is not None

    def _set_levels(self, measurement_noise: float | tuple[float, ...], process_noise: float) -> None:
        """Build maps, tracker and monitor for noise levels; the monitor restarts."""
        levels: dict[str, Any] = {"measurement_noise": measurement_noise, "process_noise": process_noise}
        kkl = KKL(self.artifact, gate=self._gate, **levels, **self._options)
        if self._state is not None and kkl.monitor is not None:
            self._state = np.hstack([self._state[:, : kkl.watched.start], kkl.monitor.start(len(self._state))])
        self._kkl, self._measurement_noise, self._process_noise = kkl, measurement_noise, process_noise

    def replace(self, artifact: Artifact) -> None:
        """From now on, use the maps of another artifact with the same filter. The filter's state stays unchanged.

        If the new map tracks and the old map did not, tracking starts at the current sample. A monitor restarts.

        Parameters
        ----------
        artifact : Artifact
            An artifact for the same plant, with the same signals, A, B and dt.

        Raises
        ------
        ValueError
            If the artifact differs in more than its maps, does not cover the noise level, or lacks the monitor
            limits or motion model that the observer's arguments need. The observer is then unchanged.
        """
        check_replacement(self.artifact, artifact)
        how: dict[str, Any] = {**self._options, "gate": self._gate, "delay": self._delay}
        other = KKLObserver(artifact, self._measurement_noise, process_noise=self._process_noise, **how)
        if self._state is not None:
            other._state, other._batch = other._kkl.take_over(self._kkl, self._state), self._batch
            other._pending = self._pending
        vars(self).update(vars(other))

    @property
    def estimator(self) -> KKL:
        """The observer as an :class:`observers.estimator.Estimator`, whose state the caller keeps."""
        return self._kkl

    @property
    def z(self) -> np.ndarray:
        """The filter's state [z_y, z_u], driven by y and by u: a copy (..., nz (1 + nu)). RuntimeError before reset."""
        state = self._begun()
        return state[:, self._kkl.z].reshape(*self._batch, self.artifact.filter.size).copy()

    def reset(self, y0: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
        """Start at a first sample.

        Parameters
        ----------
        y0 : array_like, shape (..., ny)
            The sample; its shape sets the batch.
        x0 : array_like, shape (..., nx), optional
            The state, if it is known. With T, the filter then starts without transient: at z_y = T(x0) and z_u = 0, as
            if it had always followed a motion without input. An observer that tracks starts at x0 itself, limited
            to the states' bounds, with or without T. If x0 is known in some rows only, pass it to :meth:`restart`.

        Returns
        -------
        ndarray, shape (..., nx)
            The first estimate: T_inv(z_0), or the tracker's, which is x0 if given.

        Raises
        ------
        ValueError
            If a shape is wrong, an entry is not a finite real number, or x0 is given, but the map has no T and the
            observer does not track. The observer is then unchanged.
        """
        y0 = real_array("y", y0).copy()  # the caller may reuse its array
        check_output(self.artifact, y0, y0.shape[:-1])
        self._state, self._batch = self._begin(y0, x0), y0.shape[:-1]
        n = len(self._state)
        self._pending = Pending(np.zeros((n, self._delay, self.artifact.nu)), np.zeros(n, dtype=int))
        return self.decode()

    def _begin(self, y0: np.ndarray, x0: np.ndarray | None) -> np.ndarray:
        """Return the internal state (n, width) at first samples (..., ny) and, if given, known states (..., nx)."""
        z0, age = first_state(self.artifact, self.tracking, y0, x0)
        n = math.prod(y0.shape[:-1])
        x0 = None if x0 is None else real_array("x0", x0).reshape(n, self.artifact.nx)
        return self._kkl.begin(y0.reshape(n, self.artifact.ny), z0.reshape(n, self.artifact.filter.size), age, x0)

    @property
    def score(self) -> np.ndarray:
        """How badly the samples since reset fit the estimates, shape (...,): above 1 a fault is likely.

        With the running mean and mean square of y - h(x_hat), it is the largest of |mean| / limit, mean square / upper
        limit and lower limit / mean square. It is 0 in the warm-up after a reset. Missing outputs do not change it.
        Biased, frozen and dead sensors raise it, and so do states outside the training. :class:`observers.Limits` gives
        the rate of false alarms. Raises RuntimeError before :meth:`reset`, or without ``monitor=True``.
        """
        if self._kkl.monitor is None or self._state is None:
            raise RuntimeError("score needs an observer made with monitor=True, and reset(y0)")
        return self._kkl.monitor.score(self._state[:, self._kkl.watched]).reshape(self._batch)

    @property
    def rejected(self) -> np.ndarray:
        """Number of outputs that the gate has rejected since reset, shape (...,).

        Raises RuntimeError before :meth:`reset`, or without a ``gate``.
        """
        if self._gate is None or self._state is None:
            raise RuntimeError("rejected needs an observer made with a gate, and reset(y0)")
        return self._kkl.rejected(self._state).reshape(self._batch)

    @property
    def mismatch(self) -> np.ndarray:
        """Distance of the filter's state z_y from T(x_hat), shape (...,).

        It is the root mean square of (T(x_hat) - z_y) / :attr:`ForwardMap.z_scale` over the entries of z_y. It is large
        in the transient, under inputs and sensor faults, on another plant, and outside the training; noise adds a
        little. It does not show a fault that keeps z on the image of T. Compare it with its value in sound runs.
        Raises RuntimeError before :meth:`reset`, and ValueError if the artifact holds no T.
        """
        z, T = self.z, self.artifact.require_forward()
        x_hat = self._kkl.decode(self._begun()).reshape(*self._batch, self.artifact.nx)  # at the time of z
        difference = (T(x_hat) - z[..., : len(T.z_scale)]) / T.z_scale
        return np.sqrt(np.mean(difference**2, axis=-1, keepdims=True))[..., 0]

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray | None = None) -> None:
        """Start again at first samples in some rows of the batch.

        Raises the errors of :meth:`reset`, and RuntimeError before the first reset.

        Parameters
        ----------
        y0, x0
            As for :meth:`reset`, with a row for each True in ``rows``.
        rows : array_like of bool, shape (...,)
            The rows of the batch.
        """
        state = self._begun()
        rows = bool_array("rows", rows, self._batch)
        y0 = real_array("y", y0)
        check_output(self.artifact, y0, (int(rows.sum()),))
        begun = self._begin(y0, x0)
        self._state, self._pending = state.copy(), self._pending.restarted(rows.ravel())
        self._state[rows.ravel()] = begun

    def step(self, y: np.ndarray | None, u: np.ndarray | None = None, *, dt: float | None = None) -> np.ndarray:
        """Process the next sample.

        If outputs are missing, such as those of slower sensors, the observer predicts them: by its motion model if it
        tracks, else by h(T_inv(z)). Without h, a missing output keeps its last value.

        Parameters
        ----------
        y : array_like, shape (..., ny), or None
            The sample; None if it is missing. NaN marks single outputs, or rows of a batch, that are missing.
        u : array_like, shape (..., nu), optional
            The input held since the last sample, by default zero.
        dt : float, optional
            Seconds since the last sample, by default the map's sampling interval, and at most 1,000 intervals. A
            learned flow, like a system in discrete time, needs a whole multiple of the interval.

        Returns
        -------
        ndarray, shape (..., nx)
            The estimate.

        Raises
        ------
        ValueError
            If a shape is wrong, an entry is not a finite real number (apart from NaN in ``y``), a nonzero input is
            given to a map without inputs, ``dt`` is not as described above, or ``dt`` and a delay are both given. The
            observer is then unchanged.
        RuntimeError
            Before :meth:`reset`.
        """
        self.advance(y, u, dt=dt)
        return self.decode()

    def advance(
        self,
        y: np.ndarray | None,
        u: np.ndarray | None = None,
        rows: np.ndarray | None = None,
        *,
        dt: float | None = None,
    ) -> None:
        """Process the next sample without computing an estimate. The errors are those of :meth:`step`.

        Parameters
        ----------
        y, u, dt
            As for :meth:`step`.
        rows : array_like of bool, shape (...,), optional
            The rows of the batch to advance, by default all.
        """
        state, batch = self._state, self._batch
        if state is None:
            raise RuntimeError("call reset(y0) before step(y)")
        if rows is not None:
            rows = bool_array("rows", rows, batch).ravel()
        u = held_input(self.artifact, u, batch, self._warn).reshape(len(state), self.artifact.nu)
        y = np.full((*batch, self.artifact.ny), np.nan) if y is None else real_array("y", y)
        check_output(self.artifact, y, batch, self._warn)
        y = y.reshape(len(state), self.artifact.ny)
        dt = None if dt is None else check_dt(dt)
        if self._delay:
            if dt is not None:
                raise ValueError("with a delay, samples must be one interval of the map apart: leave dt out")
            every = np.ones(len(u), dtype=bool)
            self._pending, u, rows = self._pending.after(u, every if rows is None else rows)
        if rows is None:
            self._state = self._kkl.step(state, y, u, dt)
        elif rows.any():
            self._state = state.copy()
            self._state[rows] = self._kkl.step(state[rows], y[rows], u[rows], dt)

    def _warn(self, text: str) -> None:
        """Warn once for each kind of message; the first 12 characters identify the kind."""
        if text[:12] not in self._warned:
            self._warned = self._warned | {text[:12]}
            warnings.warn(text, stacklevel=5)

    def decode(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the current estimate: the tracker's, or T_inv(z).

        Raises ValueError if ``rows`` does not fit the batch, and RuntimeError before :meth:`reset`.

        Parameters
        ----------
        rows : array_like of bool, shape (...,), optional
            The rows of the batch to estimate, by default all.

        Returns
        -------
        ndarray, shape (..., nx) or (number of True in rows, nx)
            The estimate.
        """
        state, batch = self._some(rows)
        return self._kkl.decode(state).reshape(*batch, self.artifact.nx)

    @property
    def parameters_hat(self) -> np.ndarray:
        """Current estimates of the uncertain parameters :attr:`Artifact.estimated_parameters`, shape (..., number).

        Raises RuntimeError before :meth:`reset`, and ValueError if the artifact estimates no parameters.
        """
        state = self._begun()
        parameters = self._kkl.parameters_hat(state)
        return parameters.reshape(*self._batch, parameters.shape[-1])

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the error x - x_hat of the current estimate, shape (..., nx, nx).

        It is calibrated on runs by noise level and time since reset: 90 % of errors have (x - x_hat)^T P^-1 (x - x_hat)
        below the 90 % quantile of the chi-square distribution with nx degrees of freedom. For a tracker it is the
        calibrated covariance of its Kalman filter. On another plant, under a faulty sensor or far outside the training,
        P is too small. Raises RuntimeError before :meth:`reset`, and ArtifactError if the artifact holds no covariance.
        """
        return self.decode_covariance()

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of each state's error, shape (..., nx): the roots of :attr:`covariance`'s diagonal."""
        return standard_deviations(self.decode_covariance())

    def decode_covariance(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the :attr:`covariance` of all rows, or of those that ``rows`` marks as in :meth:`decode`."""
        state, batch = self._some(rows)
        self.artifact.require_covariance()
        return self._kkl.covariance(state).reshape(*batch, self.artifact.nx, self.artifact.nx)

    def _begun(self) -> np.ndarray:
        if self._state is None:
            raise RuntimeError("call reset(y0) before the observer is used")
        return self._state

    def _some(self, rows: np.ndarray | None) -> tuple[np.ndarray, tuple[int, ...]]:
        """Return the internal state of some rows, predicted to now if outputs are delayed, and their batch's shape."""
        state, batch = self._begun(), self._batch
        chosen: Any = slice(None)
        if rows is not None:
            chosen = bool_array("rows", rows, batch).ravel()
            state = state[chosen]
            batch = (len(state),)
        if self._delay:
            state = self._kkl.ahead(state, self._pending.inputs[chosen], self._pending.count[chosen])
        return state, batch
