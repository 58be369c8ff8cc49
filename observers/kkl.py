"""The observer without its own state: linear filter, T_inv, tracker and monitor; the caller keeps the state."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.compiled_step import CompiledStep
from observers.decoder import Decoders
from observers.estimator import Estimate, Estimator
from observers.filter import LinearFilter
from observers.machine import available
from observers.monitor import Monitor
from observers.tracker import Tracker

_MAX_SAMPLES = 1000  # longest step, in sampling intervals
_CHUNK = 8192  # rows of the state that are decoded together; more would exceed the processor's cache


@dataclass(frozen=True)
class Pending:
    """Inputs (n, delay, nu) whose outputs have not arrived yet, and their number (n,). Instances are immutable."""

    inputs: np.ndarray
    count: np.ndarray

    def restarted(self, rows: np.ndarray) -> "Pending":
        """Return a copy without inputs where ``rows`` (n,) is True."""
        return Pending(self.inputs, np.where(rows, 0, self.count))

    def after(self, u: np.ndarray, rows: np.ndarray) -> tuple["Pending", np.ndarray, np.ndarray]:
        """Append the next sample's inputs (n, nu) where ``rows`` (n,) is True.

        Returns the new object, the oldest inputs (n, nu), and a mask (n,) of the rows where their outputs arrive now.
        """
        delay = self.inputs.shape[1]
        due, first = rows & (self.count == delay), self.inputs[:, 0]
        inputs = np.where(due[:, None, None], np.roll(self.inputs, -1, axis=1), self.inputs)
        count, at = self.count + (rows & ~due), np.flatnonzero(rows)
        inputs[at, count[at] - 1] = u[at]
        return Pending(inputs, count), first, due


class KKL(Estimator[np.ndarray]):
    """The estimator inside :class:`observers.KKLObserver`, for n rows.

    A row of the state holds z (size), the last output (ny), the age, and then the values of tracker and monitor.
    The age is the time since reset in sampling intervals: NaN before the first sample, infinite after a start at T(x0).
    """

    def __init__(
        self,
        artifact: Artifact,
        *,
        measurement_noise: float | tuple[float, ...],
        process_noise: float,
        tracking: bool | None,
        monitor: bool,
        compiled: bool | None,
        gate: float | None = None,
    ) -> None:
        levels: dict[str, Any] = {"measurement_noise": measurement_noise, "process_noise": process_noise}
        self.artifact, self._choice = artifact, compiled
        self._options = levels | {"compiled": compiled}
        self.decoders = Decoders(artifact, slice(artifact.nx), **self._options)
        tracks = artifact.motion is not None and (tracking is None or tracking)
        self.tracker = Tracker(artifact, self.decoders, **levels, gate=gate) if tracks else None
        limits = artifact.limits if monitor else None
        self.monitor = None if limits is None else Monitor(limits, measurement_noise, artifact.filter.dt)
        size, ny = artifact.filter.size, artifact.ny
        self.z, self.y, self.age = slice(size), slice(size, size + ny), size + ny
        end = self.age + 1 + (0 if self.tracker is None else self.tracker.width)
        self.tracked, self.watched = slice(self.age + 1, end), slice(end, None)
        self._x = slice(self.age + 1, self.age + 1 + artifact.nx)  # the tracker's estimate
        self.width = end + (0 if self.monitor is None else self.monitor.width)

    def start(self, n: int) -> np.ndarray:
        """Return rows before their first sample; see :class:`Estimator`."""
        return np.full((n, self.width), np.nan)

    def begin(self, y: np.ndarray, z: np.ndarray, age: Any, x0: np.ndarray | None = None) -> np.ndarray:
        """Return rows that start at samples (n, ny), filter states (n, size) and, if given, known states (n, nx)."""
        state = np.empty((len(y), self.width))
        state[:, self.z], state[:, self.y], state[:, self.age] = z, y, age
        if self.tracker is not None:
            state[:, self.tracked] = self.tracker.supervise(self.tracker.begin(y, x0), z, state[:, self.age])
        if self.monitor is not None:
            state[:, self.watched] = self.monitor.start(len(y))
        return state

    def take_over(self, other: "KKL", state: np.ndarray) -> np.ndarray:
        """Continue the rows of ``other``, which has the same filter; a tracker starts if ``other`` has none."""
        new = self.begin(state[:, other.y], state[:, other.z], state[:, other.age])
        if self.tracker is not None and other.tracker is not None:
            new[:, self.tracked] = self.tracker.take_over(state[:, other.tracked])
        return new

    def advance(
        self, state: np.ndarray, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None
    ) -> np.ndarray:
        """Return rows after samples and inputs; see :class:`Estimator`."""
        u = np.zeros((len(y), self.artifact.nu)) if u is None else u
        shapes = (len(y), self.width), (len(y), self.artifact.ny), (len(y), self.artifact.nu)
        if (state.shape, y.shape, u.shape) != shapes:  # machine code would read beyond smaller arrays
            raise ValueError(f"state, y and u must have shapes {shapes}, got {state.shape}, {y.shape} and {u.shape}")
        begun = ~np.isnan(state[:, self.age])
        if begun.all():
            return self.step(state, y, u, dt)
        state, first = state.copy(), ~begun & np.isfinite(y).all(-1)
        state[begun] = self.step(state[begun], y[begun], u[begun], dt)
        state[first] = self.begin(y[first], self.artifact.filter.start(y[first]), 0.0)
        return state

    def step(self, state: np.ndarray, y: np.ndarray, u: np.ndarray, dt: float | None = None) -> np.ndarray:
        """Return rows after samples (n, ny) and inputs (n, nu); all rows must have started."""
        if self._machine is None:
            new = self._stepped(state, y, u, dt)
        else:
            new = state.copy()
            self._machine(self._filter(dt), new, y[None], u[None])
        if self.monitor is not None:  # the residuals of outputs that the gate rejected count, too
            residual = self.artifact.residual(np.where(np.isnan(y), new[:, self.y], y), self.decode(new))
            new[:, self.watched] = self.monitor.update(new[:, self.watched], residual, ~np.isnan(y))
        return new

    def _filter(self, dt: float | None) -> LinearFilter:
        """Return the linear filter at a sampling interval, by default the artifact's."""
        linear = self.artifact.filter
        if dt is None or dt == linear.dt:
            return linear
        samples = dt / linear.dt
        if samples > _MAX_SAMPLES:
            raise ValueError(f"dt must be at most {_MAX_SAMPLES * linear.dt:g} s, got {dt:g}: reset after long gaps")
        if self.tracker is not None:
            self.tracker.motion.check_samples(samples)
        return linear.at(dt)

    def _stepped(self, state: np.ndarray, y: np.ndarray, u: np.ndarray, dt: float | None) -> np.ndarray:
        """Return rows after a step in NumPy; the monitor's values stay unchanged."""
        z, before, age = state[:, self.z], state[:, self.y], state[:, self.age]
        linear, tracker, gaps = self._filter(dt), self.tracker, np.isnan(y)
        samples = linear.dt / self.artifact.filter.dt
        if tracker is not None:
            tracked, y = tracker.advance(state[:, self.tracked], y, u, samples)
            y = np.where(np.isfinite(y), y, before)
        elif gaps.any():
            y = _filled(y, gaps, before, before)
            if self.artifact.knows_output:
                rows = gaps.any(-1)
                y[rows] = self._predicted(y[rows], gaps[rows], u[rows], state[rows], linear)
        z = linear.advance(z, before, u, y)
        parts = [z, y, age[:, None] + samples]
        if tracker is not None:
            parts.append(tracker.supervise(tracked, z, age + samples))
        return np.concatenate([*parts, state[:, self.watched]], axis=1)

    def _predicted(
        self, y: np.ndarray, gaps: np.ndarray, u: np.ndarray, state: np.ndarray, linear: LinearFilter
    ) -> np.ndarray:
        """Fill gaps by h(T_inv(z)) at the last z, advance the filter by this sample, and fill again at the new z."""
        z, before, age = state[:, self.z], state[:, self.y], state[:, self.age]
        following, age = z, age * self.artifact.filter.dt
        for ahead in (0.0, linear.dt):
            h = self.artifact.output(self.decoders(following, age + ahead))
            y = _filled(y, gaps, h, before)
            following = linear.advance(z, before, u, y)
        return y

    def estimate(self, state: np.ndarray) -> Estimate:
        """Return estimates, covariances and scores; see :class:`Estimator`."""
        covariance = None if self.artifact.inverse.error_covariance is None else self.covariance(state)
        score = None if self.monitor is None else self.monitor.score(state[:, self.watched])
        return Estimate(self.decode(state), covariance, score)

    def ahead(self, state: np.ndarray, u: np.ndarray, waiting: np.ndarray) -> np.ndarray:
        """Return rows predicted ahead under inputs (n, delay, nu); ``waiting`` (n,) counts the inputs of each row."""
        for k in range(int(waiting.max(initial=0))):
            rows = waiting > k
            missing = np.full((int(rows.sum()), self.artifact.ny), np.nan)
            state = state.copy()
            state[rows] = self.step(state[rows], missing, u[rows, k])
        return state

    def decode(self, state: np.ndarray) -> np.ndarray:
        """Return the estimates, (n, nx)."""
        if self.tracker is not None:
            return state[:, self._x].copy()
        if len(state) == 1:  # compiled code decodes a single sample
            return self.decoders(state[0, self.z], state[0, self.age] * self.artifact.filter.dt)[None]
        return self.decoders(state[:, self.z], state[:, self.age] * self.artifact.filter.dt)

    def covariance(self, state: np.ndarray) -> np.ndarray:
        """Return the covariances of the estimates' errors, (n, nx, nx)."""
        if self.tracker is not None:
            return self.tracker.covariance(state[:, self.tracked], state[:, self.age])
        return self.decoders.covariances(state[:, self.z], state[:, self.age] * self.artifact.filter.dt)

    def parameters_hat(self, state: np.ndarray) -> np.ndarray:
        """Return the estimates of the uncertain parameters, (n, number)."""
        artifact = self.artifact
        if not artifact.estimated_parameters:
            raise ValueError(
                f"this observer for {artifact.system!r} estimates no parameters: train one that does "
                "with kkl-gym train SYSTEM --uncertain 0.1 --set estimate_parameters=true"
            )
        return self._parameters(state[:, self.z], state[:, self.age] * artifact.filter.dt)

    def rejected(self, state: np.ndarray) -> np.ndarray:
        """Return the numbers of outputs that the gate has rejected, (n,)."""
        assert self.tracker is not None
        return state[:, self.tracked][:, self.tracker.nis + 3].astype(int)

    @functools.cached_property
    def _parameters(self) -> Decoders:
        return Decoders(self.artifact, slice(self.artifact.nx, None), **self._options)

    def along(
        self, state: np.ndarray, y: np.ndarray, u: np.ndarray, of: Any, dts: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the values of ``of``, a function of rows, at each sample of a record that begins with ``state``.

        Shapes: ``y`` (steps, n, ny), ``u`` (steps - 1, n, nu), ``dts`` (steps - 1,); returns (steps, n, ...).
        """
        if dts is None and self._machine is not None and of == self.decode:
            estimates = np.empty((len(y), *state[:, self._x].shape))
            estimates[0] = state[:, self._x]
            self._machine(self.artifact.filter, state.copy(), y[1:], u, estimates[1:])
            return estimates
        parts, rows = [of(state)[None]], max(1, _CHUNK // max(1, len(state)))
        for first in range(1, len(y), rows):
            samples, inputs = y[first : first + rows], u[first - 1 : first - 1 + rows]
            record = np.empty((len(samples), *state.shape))
            if dts is None and self._machine is not None:
                state = state.copy()
                self._machine(self.artifact.filter, state, samples, inputs, record)
            else:
                for k in range(len(samples)):
                    dt = None if dts is None else float(dts[first - 1 + k])
                    record[k] = state = self.step(state, samples[k], inputs[k], dt)
            values = of(record.reshape(len(samples) * len(state), self.width))
            parts.append(values.reshape(len(samples), len(state), *values.shape[1:]))
        return np.concatenate(parts)

    @functools.cached_property
    def _machine(self) -> CompiledStep | None:
        """The compiled step; None without a tracker or Numba, with ``compiled=False``, or if it would be too large.

        Without a tracker the step is a matrix product, which is as fast in NumPy.
        """
        if self._choice is False or self.tracker is None or not available():
            return None
        try:
            return CompiledStep(self.artifact, self.decoders, self.tracker)
        except ValueError:
            return None

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_machine"}  # built again after unpickling


def _filled(y: np.ndarray, gaps: np.ndarray, predicted: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return samples with gaps filled by predicted outputs, or by the last outputs where predictions are undefined."""
    return np.where(gaps, np.where(np.isfinite(predicted), predicted, before), y)
