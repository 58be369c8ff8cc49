"""Does the measured output still fit the estimate? A cheap test on what the observer sees anyway."""

from dataclasses import dataclass

import numpy as np

from observers.checks import check_dt, is_finite, noise_level, real_array, shown

_LARGEST = 1e30  # of limits and levels; their squares are within the range of floats


@dataclass(frozen=True)
class Limits:
    """How far the residual y - C x_hat strays in sound operation, by noise level.

    Found by simulation (:func:`training.calibrate`): under white noise of a level, the process noise of the
    environments and random inputs, a run of ``duration`` seconds exceeds one of the limits with probability
    ``false_alarms``.

    Parameters
    ----------
    levels : ndarray, shape (k,)
        Standard deviations of the measurement noise, rising from 0. Limits are interpolated between them.
    mean : ndarray, shape (k, ny)
        Limits of the absolute running mean of the residual.
    low, high : ndarray, shape (k, ny)
        Limits of the running mean square of the residual. ``low`` is 0 where there is no noise to be missed.
    window : float
        Time constant of the running means, in seconds.
    warm_up : float
        Seconds after reset in which the observer is still converging and nothing is judged.
    false_alarms : float
        Probability of an alarm in a sound run, within (0, 1).
    duration : float
        Seconds of such a run.

    Raises
    ------
    ValueError
        If a shape is wrong, a limit is not finite or out of order, or a number is out of range.
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
        k = self.levels.size
        if self.levels.ndim != 1 or k < 1 or self.levels[0] != 0 or not (np.diff(self.levels) > 0).all():
            raise ValueError(f"levels must rise from 0, got {self.levels}")
        if not self.mean.shape == self.low.shape == self.high.shape == (k, *self.mean.shape[1:]) or self.mean.ndim != 2:
            raise ValueError(f"limits must be (levels, ny), got {self.mean.shape}, {self.low.shape}, {self.high.shape}")
        if not ((self.mean > 0) & (self.low >= 0) & (self.high > self.low)).all():
            raise ValueError("limits must be positive, the low ones below the high ones")
        if not all((limit <= _LARGEST).all() for limit in (self.levels, self.mean, self.high)):
            raise ValueError(f"limits and their levels must be finite, and not beyond {_LARGEST:g}")
        for name in ("window", "warm_up", "false_alarms", "duration"):
            if not is_finite(getattr(self, name)):
                raise ValueError(f"the limits' {name} must be a finite number, got {shown(getattr(self, name))}")
            object.__setattr__(self, name, float(getattr(self, name)))
        if not (self.window > 0 and 0 <= self.warm_up < self.duration and 0 < self.false_alarms < 1):
            raise ValueError(
                "limits need window > 0, 0 <= warm_up < duration and 0 < false_alarms < 1, got "
                f"{self.window}, {self.warm_up}, {self.duration} and {self.false_alarms}"
            )

    def at(self, level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the limits at a noise level.

        Parameters
        ----------
        level : float
            Standard deviation of the measurement noise.

        Returns
        -------
        mean, low, high : ndarray, shape (ny,)
            Limits, interpolated as variances add up.

        Raises
        ------
        ValueError
            If the level is no number, negative or beyond the last one.
        """
        level = noise_level("the noise level", level)
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
    limits : Limits
        The limits of sound operation.
    level : float
        Standard deviation of the measurement noise.
    dt : float
        Sampling interval in seconds.

    Raises
    ------
    ValueError
        If there are no limits for the level, or dt is not positive and finite.
    """

    def __init__(self, limits: Limits, level: float, dt: float) -> None:
        if not isinstance(limits, Limits):
            raise ValueError(f"limits must be observers.Limits, got {shown(limits)}")
        level, dt = noise_level("the noise level", level), check_dt(dt)
        self._limits = limits.at(level)
        self._share = -np.expm1(-dt / limits.window)
        self._silent = np.round(limits.warm_up / dt)
        self._sound = np.maximum(level**2, self._limits[1])  # where the running mean square begins

    def reset(self, batch: tuple[int, ...]) -> None:
        """Begin anew.

        Parameters
        ----------
        batch : tuple of int
            Shape (...,) of the batch from here on.
        """
        ny = len(self._sound)
        self._mean = np.zeros((*batch, ny))
        self._square = np.broadcast_to(self._sound, (*batch, ny)).copy()
        self._age = np.zeros(batch, dtype=int)

    def restart(self, rows: np.ndarray) -> None:
        """Begin anew in some rows.

        Parameters
        ----------
        rows : ndarray of bool, shape (...,)
            The rows.
        """
        self._mean[rows], self._square[rows], self._age[rows] = 0.0, self._sound, 0

    def update(self, residual: np.ndarray, rows: np.ndarray | None = None) -> None:
        """Take in residuals y - C x_hat.

        Parameters
        ----------
        residual : ndarray, shape (..., ny)
            The residuals.
        rows : ndarray of bool, shape (...,), optional
            The rows whose residuals count; by default all.
        """
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
