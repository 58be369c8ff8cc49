"""Does the measured output still fit the estimate? A cheap test on what the observer sees anyway."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Limits:
    """How far the residual y - C x_hat strays in sound operation, by noise level.

    Found by simulation (:func:`training.calibrate`): under white noise of a level, the process noise of the
    environments and random inputs, a run of ``duration`` seconds exceeds one of the limits with probability
    ``false_alarms``.

    levels : standard deviations of the noise, rising from 0, (k,); limits are interpolated between them.
    mean : of the absolute running mean of the residual, (k, ny).
    low, high : of its running mean square, (k, ny); ``low`` is 0 where there is no noise to be missed.
    window : time constant of the running means, in seconds.
    warm_up : seconds after reset in which the observer is still converging and nothing is judged.
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
        k = len(self.levels)
        if self.levels.ndim != 1 or k < 1 or self.levels[0] != 0 or (np.diff(self.levels) <= 0).any():
            raise ValueError(f"levels must rise from 0, got {self.levels}")
        if not self.mean.shape == self.low.shape == self.high.shape == (k, *self.mean.shape[1:]) or self.mean.ndim != 2:
            raise ValueError(f"limits must be (levels, ny), got {self.mean.shape}, {self.low.shape}, {self.high.shape}")
        if not ((self.mean > 0) & (self.low >= 0) & (self.high > self.low)).all():
            raise ValueError("limits must be positive, the low ones below the high ones")
        sane = 0 < self.window < np.inf and 0 <= self.warm_up < np.inf and 0 < self.duration < np.inf
        if not sane or not 0 < self.false_alarms < 1:
            raise ValueError("window and duration must be positive, warm_up not negative, false_alarms within (0, 1)")

    def at(self, level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Limits of mean, low and high at a noise level, each (ny,)."""
        if level > self.levels[-1]:
            raise ValueError(f"no limits beyond noise {self.levels[-1]:g}, got {level:g}: calibrate for it")

        def between(squares: np.ndarray) -> np.ndarray:  # as variances add up
            return np.array([np.interp(level**2, self.levels**2, column) for column in squares.T])

        return np.sqrt(between(self.mean**2)), between(self.low), between(self.high)


class Monitor:
    """Running mean and mean square of the residual, against their limits.

    A biased sensor moves the mean, a frozen or dead one lets the noise go missing, and whatever takes the filter's
    state away from those that the map was trained on makes the residual large.

    Parameters
    ----------
    limits : of sound operation.
    level : standard deviation of the measurement noise.
    dt : sampling interval in seconds.

    Raises ValueError if there are no limits for the level.
    """

    def __init__(self, limits: Limits, level: float, dt: float) -> None:
        self._limits = limits.at(level)
        self._share = -np.expm1(-dt / limits.window)
        self._silent = round(limits.warm_up / dt)
        self._sound = np.maximum(level**2, self._limits[1])  # where the running mean square begins

    def reset(self, batch: tuple[int, ...]) -> None:
        """Begin anew, with rows of shape (...,)."""
        ny = len(self._sound)
        self._mean = np.zeros((*batch, ny))
        self._square = np.broadcast_to(self._sound, (*batch, ny)).copy()
        self._age = np.zeros(batch, dtype=int)

    def restart(self, rows: np.ndarray) -> None:
        """Begin anew in some rows, boolean (...,)."""
        self._mean[rows], self._square[rows], self._age[rows] = 0.0, self._sound, 0

    def update(self, residual: np.ndarray, rows: np.ndarray | None = None) -> None:
        """Take in residuals y - C x_hat, (..., ny); with ``rows``, boolean (...,), those of some rows only."""
        share = self._share if rows is None else self._share * rows[..., None]
        self._mean += share * (residual - self._mean)
        self._square += share * (residual**2 - self._square)
        self._age += 1 if rows is None else rows

    @property
    def score(self) -> np.ndarray:
        """How close to an alarm: above 1 a limit is exceeded, (...,); 0 while nothing is judged yet."""
        mean, low, high = self._limits
        worst = np.maximum(np.abs(self._mean) / mean, self._square / high)
        worst = np.maximum(worst, low / np.maximum(self._square, 1e-300))
        return np.where(self._age > self._silent, worst.max(-1), 0.0)


__all__ = ["Limits", "Monitor"]
