"""What was found, in numbers and in words."""

from dataclasses import dataclass

import numpy as np

from training.evaluation.levels import Level

DETERMINED, UNTOLD = 0.05, 0.8  # of a signal's standard deviation: errors up to the one, and from the other on
AS_GOOD = 1.1  # times the least error, from which on a window is as good as any
SEEN = 0.1  # of the error of a signal: that of its change at most, where it is told up to a constant


@dataclass(frozen=True)
class Judgement:
    """What is said of one hidden signal."""

    signal: str
    verdict: str
    window: int | None
    errors: tuple[float, ...]
    linear: float


@dataclass(frozen=True)
class Observability:
    """What outputs and inputs tell of hidden signals.

    Errors are root mean squares in standard deviations of the signals.

    Parameters
    ----------
    measured, inputs, hidden : tuple of str
        Names of the signals.
    dt : float
        Seconds in a step.
    windows : tuple of int, length m
        Steps back that outputs and inputs are known; 0 is the output alone.
    noise : tuple of (float or tuple of float), length k
        Levels of measurement noise; the first is 0.
    errors : ndarray, shape (k, m, nx) or (1, m, nx)
        That the best estimate leaves after so many steps; without noise alone where equations say the rest.
    predicted : ndarray, shape (k, nx)
        The same of the best window; where there are equations, of a default filter's whole run, transients included.
    changes : ndarray, shape (m, nx)
        That it leaves of how much a signal has changed over the window, in standard deviations of that change, without
        noise; NaN where nothing has, and over windows of which the filter forgets where they began.
    linear : ndarray, shape (m, nx)
        That the best linear function leaves, without noise.
    least : ndarray, shape (k, nx), or None
        What is left to who knows the equations, where there are any; NaN without noise.
    warnings : tuple of str
        What else is to be known.
    """

    measured: tuple[str, ...]
    inputs: tuple[str, ...]
    hidden: tuple[str, ...]
    dt: float
    windows: tuple[int, ...]
    noise: tuple[Level, ...]
    errors: np.ndarray
    predicted: np.ndarray
    changes: np.ndarray
    linear: np.ndarray
    least: np.ndarray | None = None
    warnings: tuple[str, ...] = ()

    @property
    def judgements(self) -> tuple[Judgement, ...]:
        """What is said of each hidden signal."""
        return tuple(map(self._judged, range(len(self.hidden))))

    def _judged(self, i: int) -> Judgement:
        errors, exact = tuple(self.predicted[:, i].tolist()), self.errors[0, :, i]
        least, window = errors[0], self._first(exact <= max(DETERMINED, AS_GOOD * exact.min()))
        if np.isnan(least):
            verdict, window = "never moves", None
        elif least <= DETERMINED:
            verdict = "determined"
        elif self._longest_change(i) <= min(DETERMINED, SEEN * least):
            verdict, window = "up to a constant", self._first(self.changes[:, i] <= DETERMINED)
        elif least < UNTOLD:
            verdict = f"partly ({100 * least:.2g} % left)"
        else:
            verdict, window = "not determined", None
        return Judgement(self.hidden[i], verdict, window, errors, float(self.linear[:, i].min()))

    def _longest_change(self, i: int) -> float:
        known = self.changes[~np.isnan(self.changes[:, i]), i]
        return float(known[-1]) if len(known) else np.nan

    def _first(self, good: np.ndarray) -> int | None:
        return self.windows[int(good.argmax())]
