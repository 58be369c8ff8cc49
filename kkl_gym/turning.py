"""A memory of signals of which some are angles: of these it keeps how far they have turned."""

import math
from collections.abc import Sequence

import numpy as np

from kkl_gym.memory import Memory

TURN = 2 * math.pi


def turned(cosines: np.ndarray, sines: np.ndarray, before: np.ndarray | float) -> np.ndarray:
    """Angles in rad that have turned by less than half a turn since before, and have not where nothing is known."""
    angles = np.arctan2(sines, cosines)
    nearest = angles - TURN * np.rint((angles - before) / TURN)
    if np.count_nonzero(cosines) == np.count_nonzero(np.isfinite(nearest)) == nearest.size:
        return nearest  # as nearly always, and soon found out
    return np.where(cosines * cosines + sines * sines > 0, nearest, before)


class TurningMemory:
    """A :class:`Memory` in which an angle that is measured by its cosine and its sine is one signal.

    Filters of a cosine and a sine hold the rate of an angle only as a product with where it is. What is remembered
    here is the angle itself, unwrapped. It is taken to turn by less than half a turn from one sample to the next; one
    that is faster is remembered as turning the other way. Where cosine and sine are both 0, it is taken to rest.
    """

    def __init__(
        self,
        ny: int,
        nu: int,
        angles: Sequence[tuple[int, int]],
        *,
        time_constants: Sequence[float],
        input_time_constants: Sequence[float],
    ) -> None:
        self._cosines, self._sines = np.array(angles).T
        self._others = np.setdiff1d(np.arange(ny), [self._cosines, self._sines])
        signals = len(self._others) + len(angles)
        self._memory = Memory(signals, nu, time_constants=time_constants, input_time_constants=input_time_constants)
        self._hidden = signals  # numbers of what it shows that are the signals themselves
        self._y: np.ndarray | None = None
        self._turned = np.empty(0)  # angles in rad since the reset, (number of angles,) or (n, number of angles)

    @property
    def time_constants(self) -> tuple[float, ...]:
        """Of the outputs, in steps."""
        return self._memory.time_constants

    @property
    def input_time_constants(self) -> tuple[float, ...]:
        """Of the inputs, in steps."""
        return self._memory.input_time_constants

    def bounds(self, low: np.ndarray, high: np.ndarray, u_low: np.ndarray, u_high: np.ndarray) -> np.ndarray:
        """As :meth:`Memory.bounds`; angles may turn for ever, but by no more than half a turn in a step."""
        for_ever = np.full(len(self._cosines), np.inf)
        low_of, high_of = np.append(low[self._others], -for_ever), np.append(high[self._others], for_ever)
        change = np.append(np.full(len(self._others), np.inf), np.full(len(self._cosines), math.pi))
        of_memory = self._memory.bounds(low_of, high_of, u_low, u_high, change=change)
        return np.hstack([[low, high], of_memory[:, self._hidden :]])

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """As :meth:`Memory.reset`."""
        self._y, self._turned = y0.copy(), self._angles(y0, 0.0)
        return self._shown(self._y, self._memory.reset(self._signals()))

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """As :meth:`Memory.restart`."""
        if self._y is None:
            raise RuntimeError("reset all environments before some of them")
        self._y[rows], self._turned[rows] = y0, self._angles(y0, 0.0)
        return self._shown(y0, self._memory.restart(self._signals()[rows], rows))

    def advance(self, y: np.ndarray, u: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """As :meth:`Memory.advance`; memories of angles come after those of the other outputs, in their order."""
        if self._y is None:
            raise RuntimeError("reset the environment before its first step")
        self._y = y.copy() if rows is None else np.where(rows[:, None], y, self._y)
        self._turned = self._angles(self._y, self._turned)
        return self._shown(self._y, self._memory.advance(self._signals(), u, rows))

    def shown(self) -> np.ndarray:
        """As :meth:`Memory.shown`, of all rows."""
        if self._y is None:
            raise RuntimeError("reset the environment before its first step")
        return self._shown(self._y, self._memory.shown())

    def _angles(self, y: np.ndarray, before: np.ndarray | float) -> np.ndarray:
        return turned(y.take(self._cosines, -1), y.take(self._sines, -1), before)

    def _signals(self) -> np.ndarray:
        """What the memory filters: the other outputs, then the angles."""
        assert self._y is not None
        return np.concatenate((self._y.take(self._others, -1), self._turned), axis=-1)

    def _shown(self, y: np.ndarray, filtered: np.ndarray) -> np.ndarray:
        """Outputs in place of the signals that are filtered."""
        return np.concatenate((y, filtered[..., self._hidden :]), axis=-1, dtype=np.float32)


__all__ = ["TurningMemory", "turned"]
