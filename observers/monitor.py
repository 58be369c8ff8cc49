"""A test of whether the measured outputs still fit the estimates."""

from dataclasses import dataclass

import numpy as np

from observers.checks import check_dt, is_finite, noise_levels, real_array, shown

_LARGEST = 1e30  # largest limit or level, so that squares are finite


@dataclass(frozen=True)
class Limits:
    """Limits of the residual y - h(x_hat) in normal operation, by noise level.

    :func:`training.calibrate` simulates runs of ``duration`` seconds under white noise of each level, or takes them
    from held-out records. Such a run exceeds one of the limits with a probability of at most ``false_alarms``.
    Raises ValueError if shapes or values are invalid.

    Parameters
    ----------
    levels : ndarray, shape (k,) or (k, ny)
        Standard deviations of the measurement noise, one for all outputs or one for each, rising from 0. With one for
        each, every row is a multiple of the last row. Limits are interpolated between levels.
    mean : ndarray, shape (k, ny)
        Limits of the residual's running mean, in absolute value.
    low, high : ndarray, shape (k, ny)
        Limits of the residual's running mean square. ``low`` is 0 at level 0, where sound sensors have no noise.
    window : float
        Time constant of the running means, in seconds.
    warm_up : float
        Seconds after reset in which the observer still converges and the score is 0.
    false_alarms : float
        Highest probability of an alarm in a run without faults, within (0, 1).
    duration : float
        Duration of a run in seconds.
    """

    levels: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    window: float
    warm_up: float
    false_alarms: float
    duration: float

    def __post_init__(self) -> None:
        for name in ("levels", "mean", "low", "high"):
            object.__setattr__(self, name, real_array(f"the limits' {name}", getattr(self, name)))
        shape = self.mean.shape
        if len(shape) != 2 or not shape[0] or not shape == self.low.shape == self.high.shape:
            raise ValueError(f"limits must have shape (levels, ny), got {shape}, {self.low.shape}, {self.high.shape}")
        if self.levels.shape not in (shape[:1], shape):
            raise ValueError(f"levels must have shape {shape[:1]} or {shape}, as the limits, got {self.levels.shape}")
        if self.levels[0].any() or not (np.diff(self.levels, axis=0) > 0).all():
            raise ValueError(f"levels must rise from 0, got {self.levels}")
        if not ((self.mean > 0) & (self.low >= 0) & (self.high > self.low)).all():
            raise ValueError(f"limits need mean > 0 and high > low >= 0, got {shown((self.mean, self.low, self.high))}")
        if not all((limit <= _LARGEST).all() for limit in (self.levels, self.mean, self.high)):
            raise ValueError(f"limits and their levels must be finite, and not beyond {_LARGEST:g}")
        for name in ("window", "warm_up", "false_alarms", "duration"):
            if not is_finite(value := getattr(self, name)):
                raise ValueError(f"the limits' {name} must be a finite number, got {shown(value)}")
            object.__setattr__(self, name, float(value))
        if not (self.window > 0 and 0 <= self.warm_up < self.duration and 0 < self.false_alarms < 1):
            raise ValueError(
                "limits need window > 0, 0 <= warm_up < duration and 0 < false_alarms < 1, got "
                f"{self.window}, {self.warm_up}, {self.duration} and {self.false_alarms}"
            )

    def at(self, level: float | tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the limits at a noise level.

        An output's relative level is its noise over its largest level in ``levels``. Each output's noise reaches the
        estimate, and through it every residual. All upper limits are those at the outputs' highest relative level.

        Shapes: ``level`` is one number or (ny,); returns ``mean``, ``low`` and ``high``, (ny,) each. Mean squares
        and squared means are interpolated in the squared level. Raises ValueError if a level is invalid or too large.
        """
        ny = self.mean.shape[1]
        level = noise_levels("the noise level", level, ny)
        levels = np.broadcast_to(self.levels.reshape(len(self.levels), -1), self.mean.shape)
        own, last = np.broadcast_to(level, (ny,)), levels[-1]
        if (own > last).any():
            raise ValueError(f"no limits beyond noise {self.levels[-1].tolist()}, got {level}: calibrate for it")
        part = np.divide(own, last, out=np.zeros(ny), where=last > 0)
        noisiest = np.where(part == part.max(), own, part.max() * last)

        def between(sigma: np.ndarray, limits: np.ndarray) -> np.ndarray:  # linear in level^2
            each = zip(sigma, levels.T, limits.T, strict=True)
            return np.array([np.interp(one**2, known**2, squares) for one, known, squares in each])

        return np.sqrt(between(noisiest, self.mean**2)), between(own, self.low), between(noisiest, self.high)


class Monitor:
    """Running mean and mean square of the residual, compared with their limits.

    A biased sensor shifts the mean, a frozen or dead sensor has too little noise, and filter states far from
    those in training make the residual large.

    Parameters
    ----------
    limits : Limits
        The limits in normal operation.
    level : float or tuple of float, length ny
        Standard deviation of the measurement noise, one for all outputs or one for each.
    dt : float
        Sampling interval in seconds.

    Raises
    ------
    ValueError
        If there are no limits for the level, or dt is not positive and finite.
    """

    def __init__(self, limits: Limits, level: float | tuple[float, ...], dt: float) -> None:
        if not isinstance(limits, Limits):
            raise ValueError(f"limits must be observers.Limits, got {shown(limits)}")
        level, dt = noise_levels("the noise level", level, limits.mean.shape[1]), check_dt(dt)
        self._limits = limits.at(level)
        self._share = -np.expm1(-dt / limits.window)
        self._silent = np.round(limits.warm_up / dt)
        self._sound = np.maximum(np.square(level), self._limits[1])  # initial value of the running mean square

    @property
    def width(self) -> int:
        """Number of values in a row of the state: running means (ny), running mean squares (ny), number of samples."""
        return 2 * len(self._sound) + 1

    def start(self, n: int) -> np.ndarray:
        """Return the state (n, width) before the first sample; the caller keeps it."""
        ny = len(self._sound)
        return np.tile(np.concatenate([np.zeros(ny), self._sound, [0.0]]), (n, 1))

    def update(self, rows: np.ndarray, residual: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Return the state after ``rows``, given residuals y - h(x_hat) (n, ny); only those ``seen`` (n, ny) count."""
        mean, square, samples = self._parts(rows)
        share = self._share * seen
        mean, square = mean + share * (residual - mean), square + share * (residual**2 - square)
        return np.concatenate([mean, square, samples + seen.any(-1, keepdims=True)], axis=-1)

    def score(self, rows: np.ndarray) -> np.ndarray:
        """Return the scores (n,): above 1 if a limit is exceeded, and 0 during the warm-up."""
        (mean, square, samples), (most, low, high) = self._parts(rows), self._limits
        worst = np.maximum(np.abs(mean) / most, square / high)
        worst = np.maximum(worst, low / np.maximum(square, 1e-300))
        return np.where(samples[..., 0] > self._silent, worst.max(-1), 0.0)

    def _parts(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ny = len(self._sound)
        return rows[..., :ny], rows[..., ny : 2 * ny], rows[..., 2 * ny :]
