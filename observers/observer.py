"""The observer at run time: filter the output, invert the map."""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.checks import bool_array, noise_level, noise_levels, real_array
from observers.compiled import available
from observers.decoder import Decoders
from observers.factors import standard_deviations
from observers.monitor import Monitor
from observers.replacement import check_replacement
from observers.replay import RecordEstimates, filled
from observers.samples import check_arguments, check_output, first_state, held_input
from observers.thresholds import SOON
from observers.tracker import Tracker


class KKLObserver(RecordEstimates):
    """z' = A z + B y, x_hat = T_inv(z): a causal state estimate from sampled outputs (paper, sec. 3.2).

    ``x_hat_0 = reset(y_0)``, then ``x_hat_k+1 = step(y_k+1, u_k)`` with u_k the input held over [t_k, t_k+1].
    All calls are batched: outputs of shape (..., ny) give estimates of shape (..., nx). A step is :meth:`advance`, the
    linear filter, followed by :meth:`decode`, the network; :meth:`restart` restarts some rows of a batch.

    A filter that is switched on needs some time. Where the state x_0 is known and the artifact holds the forward map T,
    ``reset(y_0, x_0)`` begins at z_0 = T(x_0) instead. T also gives :attr:`mismatch`, the distance of z from T(x_hat).

    Where the artifact holds a motion, the observer tracks: a Kalman filter predicts the estimate by the system's
    equations, or by a learned flow, and corrects it by each sample (:class:`observers.tracker.Tracker`). T_inv's
    estimate replaces it where T_inv is surer, or where the samples show divergence.

    Parameters
    ----------
    artifact : Artifact
        What was learned.
    measurement_noise : float or sequence of float, length ny, optional
        Standard deviation of the noise on each sample, of all outputs or each, for maps that ask for it. None is what
        is usual, :attr:`observers.Artifact.measurement_noise`: 0.5 for the maps that ship.
    process_noise : float, optional
        Level of the noise on the state's derivative, in multiples of the system's scale per second as for the
        environments, for maps that ask for it. T_inv takes levels beyond its training for its largest; where the
        observer tracks, its filter takes any level. None is the system's own level, which the environments and the
        monitor's limits have too.
    monitor : bool, default False
        Whether to watch if the samples fit the estimates, see :attr:`score`.
    tracking : bool, optional
        Whether to track; False takes T_inv alone, without any model at run time. None tracks where the artifact holds a
        motion.
    compiled : bool, optional
        Whether single samples run compiled by Numba (the extra ``fast``), several times as fast; compilation takes
        seconds, once. True compiles here and after unpickling, False uses NumPy, None uses NumPy until a :meth:`reset`
        after 1,000 samples. The two agree to rounding. Batches of 128 rows or more use Numba where it is installed.

    Raises
    ------
    ImportError
        If ``compiled`` is True and Numba is not installed.
    ValueError
        If an argument has the wrong type, a noise level is negative or beyond 1e12, the measurement noise is beyond
        the map's training or differs between outputs where the map takes one level for all, or the artifact holds no
        limits for a monitor.
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
    ) -> None:
        check_arguments(artifact, monitor, compiled, tracking)
        self.artifact = artifact
        self._monitored, self._tracking = bool(monitor), None if tracking is None else bool(tracking)
        self._compile, self._compiled = compiled, bool(compiled)
        self._samples = 0  # single ones
        self._z: np.ndarray | None = None
        self._tracker: Tracker | None = None
        self._x_hat: np.ndarray | None  # where the monitor has already made the network say it
        self._process_noise = self._level(process_noise)
        self.measurement_noise = artifact.measurement_noise if measurement_noise is None else measurement_noise
        self._age: Any = 0  # samples since the filter was switched on, an array where rows have restarted
        if self._compiled:
            self._warm_up()

    @property
    def measurement_noise(self) -> float | tuple[float, ...]:
        """Standard deviation sigma_v of the measurement noise that the estimate assumes, of all outputs or each."""
        return self._measurement_noise

    @measurement_noise.setter
    def measurement_noise(self, levels: float | Sequence[float]) -> None:
        inverse = self.artifact.inverse
        level = noise_levels("measurement_noise", levels, self.artifact.ny)
        if level != (within := inverse.within(level)):
            raise ValueError(
                f"measurement_noise = {level} is beyond the map's range, 0 to {inverse.measurement_noise_max}; "
                f"pass measurement_noise={within} to use it all the same"
            )
        limits = self.artifact.limits
        monitor = Monitor(limits, level, self.artifact.filter.dt) if self._monitored and limits else None
        if monitor is not None and self._z is not None:
            monitor.reset(self._z.shape[:-1])
        self._measurement_noise, self._monitor = level, monitor
        self._x_hat = None
        self._set_levels()

    @property
    def process_noise(self) -> float:
        """Level of process noise that the estimate assumes, in multiples of the system's scale per second."""
        return self._process_noise

    @process_noise.setter
    def process_noise(self, level: float | None) -> None:
        self._process_noise, self._x_hat = self._level(level), None
        self._set_levels()

    def _level(self, process_noise: float | None) -> float:
        if process_noise is None:
            return self.artifact.process_noise_max or 0.0
        return noise_level("process_noise", process_noise)

    @property
    def tracking(self) -> bool:
        """Whether the observer tracks; else its estimate is T_inv's alone."""
        return self._tracker is not None

    def _set_levels(self) -> None:
        """Make maps and tracker for the levels of noise."""
        artifact, levels = self.artifact, self._levels
        self._states = Decoders(artifact, slice(artifact.nx), **levels)
        self._parameters: Decoders | None = None  # made where they are asked for
        before, self._tracker = self._tracker, None
        if artifact.motion is not None and self._tracking is not False:
            self._tracker = Tracker(artifact, self._states, **levels)
            if before is not None and self._z is not None:
                self._tracker.take_over(before)

    @property
    def _levels(self) -> dict[str, Any]:
        return {
            "measurement_noise": self._measurement_noise,
            "process_noise": self._process_noise,
            "compiled": self._compiled,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if not available():
            self._compiled, self._compile = False, None if self._compile else self._compile
        elif self._compiled and (self._compile or self._z is None or self._z.ndim == 1):
            self._warm_up()  # in another process there is no machine code yet

    def _warm_up(self) -> None:
        """Make the machine code for single samples now, by a sample that is forgotten."""
        linear, tracker = self.artifact.filter, copy.copy(self._tracker)
        y, u = np.zeros(self.artifact.ny), np.zeros(linear.nu)
        self._states(linear.advance_single(np.zeros(linear.size), y, u, y), 0.0)
        if tracker is not None:
            tracker.reset(y)
            tracker.advance(y, u)

    def __copy__(self) -> "KKLObserver":
        """Another that stands where this one does, and goes its own way: what is changed in place is copied too."""
        other = object.__new__(type(self))
        mine = {"_monitor": copy.deepcopy(self._monitor), "_tracker": copy.copy(self._tracker)}
        vars(other).update(vars(self) | mine)
        return other

    def replace(self, artifact: Artifact) -> None:
        """Take other maps for the same filter, whose state stays as it is: the next estimate is theirs.

        A map that tracks, in place of one that does not, starts its filter at the current sample.

        Parameters
        ----------
        artifact : Artifact
            Of the same signals, with the same A, B and dt.

        Raises
        ------
        ArtifactError
            If it differs in more than its maps.
        ValueError
            If the noise level is beyond its range, or there is a monitor, which restarts, and it holds no limits. The
            observer is then as it was.
        """
        check_replacement(self.artifact, artifact)
        other = self._twin(artifact, monitor=self._monitored)
        other._compile, other._samples = self._compile, self._samples
        if self._z is not None:
            other._z, other._y, other._age = self._z, self._y, self._age
            if other._tracker is not None and self._tracker is not None:
                other._tracker.take_over(self._tracker)
            elif other._tracker is not None:
                other._tracker.reset(self._y)
                other._tracker.supervise(self._z, self._age)
            if other._monitor is not None:
                other._monitor.reset(self._z.shape[:-1])
        vars(self).update(vars(other))

    @property
    def z(self) -> np.ndarray:
        """The filter's state [z_y, z_u], a copy of shape (..., nz * (1 + nu)); raises RuntimeError before reset."""
        return self._moment(None)[0].copy()

    def reset(self, y0: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
        """Forget the past and take in the first sample.

        Parameters
        ----------
        y0 : array_like, shape (..., ny)
            The sample; its shape is that of the batch from here on.
        x0 : array_like, shape (..., nx), optional
            The state, where it is known. The filter then starts at z_y = T(x0) and z_u = 0, as if it had run for ever
            beside a motion without input: there is no transient. An observer that tracks begins at x0 itself, cut at
            the bounds of the states, with T or without. Where only some rows are known, :meth:`restart` those.

        Returns
        -------
        ndarray, shape (..., nx)
            The first estimate: T_inv(z_0), or that of the tracker, which is x0 where it is given.

        Raises
        ------
        ValueError
            If a shape is wrong, an entry is not a finite real number, or x0 is given and the artifact holds neither T
            nor a motion; the observer is then as it was.
        """
        y0, x0 = real_array("y", y0).copy(), None if x0 is None else real_array("x0", x0)  # callers reuse arrays
        check_output(self.artifact, y0, y0.shape[:-1], first=True)
        z0, age = first_state(self.artifact, y0, x0)
        if self._compile is None and not self._compiled and y0.ndim == 1 and self._samples >= SOON and available():
            self._compiled = True
            self._set_levels()
            self._warm_up()
        if self._tracker is not None:
            self._tracker.reset(y0, x0)
            self._tracker.supervise(z0, age)
        self._z, self._y, self._age, self._x_hat = z0, y0, age, None
        if self._monitor is not None:
            self._monitor.reset(y0.shape[:-1])
        return self.decode()

    @property
    def score(self) -> np.ndarray:
        """How well the samples since reset fit the estimates, shape (...,): above 1 a fault is likely.

        The running mean and mean square of y - h(x_hat) over their limits in sound operation. It is 0 right after
        reset; missing outputs leave it as it was. A biased, frozen or dropped-out sensor raises it, and so do states
        outside the training. :class:`observers.Limits` gives the rate of false alarms.

        Raises
        ------
        RuntimeError
            Before :meth:`reset`, or without ``monitor=True``.
        """
        if self._monitor is None or self._z is None:
            raise RuntimeError("score needs an observer made with monitor=True, and reset(y0)")
        return self._monitor.score

    @property
    def mismatch(self) -> np.ndarray:
        """Distance of the filter's state from the image of T, shape (...,): 0 where z_y = T(x_hat).

        The root mean square of (T(x_hat) - z_y) / :attr:`ForwardMap.z_scale` over the modes. It is large in the
        transient, under sensor faults and inputs, on another plant, and beyond the training; noise adds a little. A
        fault that keeps z on the image of T does not show. There are no limits: measure what sound runs give.

        Raises
        ------
        RuntimeError, ValueError
            Before :meth:`reset`; if the artifact holds no T.
        """
        z, T = self.z, self.artifact.require_forward()
        apart = (T(self.decode()) - z[..., : len(T.z_scale)]) / T.z_scale
        return np.sqrt(np.mean(apart**2, axis=-1, keepdims=True))[..., 0]

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray | None = None) -> None:
        """Forget the past in some rows of the batch and take in their first samples.

        Parameters
        ----------
        y0 : array_like, shape (number of True in rows, ny)
            First samples.
        rows : array_like of bool, shape (...,)
            The rows of the batch.
        x0 : array_like, shape (number of True in rows, nx), optional
            Their states, where they are known, as for :meth:`reset`.

        Raises
        ------
        ValueError, RuntimeError
            As :meth:`reset`, and before it.
        """
        z = self.z
        rows = bool_array("rows", rows, z.shape[:-1])
        y0, x0 = real_array("y", y0), None if x0 is None else real_array("x0", x0)
        check_output(self.artifact, y0, (int(rows.sum()),), first=True)
        z[rows], age = first_state(self.artifact, y0, x0)
        self._z, self._y, self._x_hat = z, self._y.copy(), None
        self._y[rows], self._age = y0, np.where(rows, age, self._age)
        if self._tracker is not None:
            self._tracker.restart(rows, y0, x0)
            self._tracker.supervise(z, self._age, rows)
        if self._monitor is not None:
            self._monitor.restart(rows)

    def step(self, y: np.ndarray | None, u: np.ndarray | None = None) -> np.ndarray:
        """Take in the next sample.

        Without a sample the observer coasts on its own prediction of the output, h(x_hat), which makes z' = A z + B
        h(T_inv(z)) a model of the system; one that tracks coasts on its motion. Of several outputs some may be
        missing, such as those of slower sensors: it then coasts on these alone. Where the artifact holds no h, the last
        value of a missing output is held.

        Parameters
        ----------
        y : array_like, shape (..., ny), or None
            The sample; None if it is missing. NaN marks outputs, or rows of a batch, that are missing.
        u : array_like, shape (..., nu), optional
            The input held since the sample before, by default zero.

        Returns
        -------
        ndarray, shape (..., nx)
            The estimate.

        Raises
        ------
        ValueError
            If a shape is wrong, an entry is not a finite real number (or NaN as described), or an input that the map
            does not take is not zero; the observer is then as it was.
        RuntimeError
            Before :meth:`reset`.
        """
        self.advance(y, u)
        return self.decode()

    def advance(self, y: np.ndarray | None, u: np.ndarray | None = None, rows: np.ndarray | None = None) -> None:
        """Take in the next sample without an estimate: the filter's half of :meth:`step`, which raises the same.

        Parameters
        ----------
        y, u
            As for :meth:`step`.
        rows : array_like of bool, shape (...,), optional
            The rows of the batch that take it in, by default all.
        """
        if self._z is None:
            raise RuntimeError("call reset(y0) before step(y)")
        batch = self._z.shape[:-1]
        if rows is not None:
            rows = bool_array("rows", rows, batch)
        u = held_input(self.artifact, u, batch)
        gaps, missing = None, y is None
        if y is None:
            y, gaps = np.full(self._y.shape, np.nan), np.ones(self._y.shape, dtype=bool)
        else:
            y = real_array("y", y).copy()  # as in reset
            gaps = check_output(self.artifact, y, batch)
        if not batch:
            if rows is not None and not rows:
                return
            rows = None
            self._samples += 1
        tracker, linear = self._tracker, self.artifact.filter
        if tracker is not None:
            h = tracker.advance(y, u, rows)
            if gaps is not None:
                y = np.where(gaps, np.where(np.isfinite(h), h, self._y), y)
        elif gaps is not None:
            y = filled(self.artifact, self._states, y, gaps, u, z=self._z, before=self._y, age=self._age)
        advance = linear.advance_single if self._compiled and not batch else linear.advance
        z = advance(self._z, self._y, u, y)
        if rows is not None:
            z, y = np.where(rows[..., None], z, self._z), np.where(rows[..., None], y, self._y)
        self._z, self._y, self._age, self._x_hat = z, y, self._age + (1 if rows is None else rows), None
        if tracker is not None:
            tracker.supervise(self._z, self._age, rows)
        if self._monitor is not None and not missing:
            self._x_hat = self.decode()
            seen = None if rows is None else rows[..., None]
            if gaps is not None:
                seen = ~gaps if seen is None else ~gaps & seen
            self._monitor.update(self.artifact.residual(self._y, self._x_hat), seen)

    def decode(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the current estimate: T_inv(z), the network's half of :meth:`step`, or the tracker's.

        Parameters
        ----------
        rows : array_like of bool, shape (...,), optional
            The rows of the batch to estimate, by default all.

        Returns
        -------
        ndarray, shape (..., nx) or (number of True in rows, nx)
            The estimate.

        Raises
        ------
        ValueError, RuntimeError
            If ``rows`` does not fit the batch; before :meth:`reset`.
        """
        z, age = self._moment(rows)
        x_hat = self._x_hat if self._tracker is None else self._tracker.estimate
        if x_hat is not None:
            return x_hat.copy() if rows is None else x_hat[rows]
        return self._states(z, age)

    @property
    def parameters_hat(self) -> np.ndarray:
        """Current estimates of the uncertain parameters :attr:`Artifact.estimated_parameters`, shape (..., number).

        Raises
        ------
        RuntimeError
            Before :meth:`reset`.
        ValueError
            If the artifact estimates no parameters.
        """
        z, age = self._moment(None)
        return self._identifier()(z, age)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the error x - x_hat of the current estimate, shape (..., nx, nx).

        It is calibrated on runs, by level of noise and age; a tracker's also follows its filter: 90 % of the
        errors there have (x - x_hat)^T P^-1 (x - x_hat) below the 90 % quantile of the chi-square distribution with nx
        degrees of freedom. On another plant, under a faulty sensor or far from the training it is too small. Computed
        when asked for.

        Raises
        ------
        RuntimeError
            Before :meth:`reset`.
        ArtifactError
            If the artifact holds no covariance. It is a ValueError.
        """
        return self.decode_covariance()

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of each state's error, shape (..., nx): the roots of :attr:`covariance`'s diagonal."""
        return standard_deviations(self.decode_covariance())

    def decode_covariance(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance of the error of what :meth:`decode` returns.

        Parameters
        ----------
        rows : ndarray of bool, shape (...,), optional
            As for :meth:`decode`.

        Returns
        -------
        ndarray, shape (..., nx, nx) or (number of True in rows, nx, nx)
            As :attr:`covariance`, which also raises the same.
        """
        z, age = self._moment(rows)
        if self._tracker is not None:
            covariance = self._tracker.covariance(self._age)
            return covariance if rows is None else covariance[rows]
        self.artifact.require_covariance()
        return self._states.covariances(z, age)

    def _twin(self, artifact: Artifact, *, monitor: bool = False) -> "KKLObserver":
        """Another with the same levels of noise, tracking and compilation."""
        options = self._levels | {"compiled": self._compiled or self._compile, "tracking": self._tracking}
        return KKLObserver(artifact, monitor=monitor, **options)

    def _moment(self, rows: np.ndarray | None) -> tuple[np.ndarray, Any]:
        """The filter's state and its age in seconds, of some rows."""
        if self._z is None:
            raise RuntimeError("call reset(y0) before the observer is used")
        z, age = self._z, self._age
        if rows is not None:
            rows = bool_array("rows", rows, z.shape[:-1])
            z, age = z[rows], np.broadcast_to(age, rows.shape)[rows]
        return z, age * self.artifact.filter.dt

    def _identifier(self) -> Decoders:
        artifact = self.artifact
        if not artifact.estimated_parameters:
            raise ValueError(
                f"this observer for {artifact.system!r} estimates no parameters: train one that does "
                "with kkl-gym train SYSTEM --uncertain 0.1 --set estimate_parameters=true"
            )
        if self._parameters is None:
            self._parameters = Decoders(artifact, slice(artifact.nx, None), **self._levels)
        return self._parameters
