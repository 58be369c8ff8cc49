"""A linear memory of signals at equal steps: what outputs and inputs were, in a few numbers for each."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from observers import LinearFilter
from observers.checks import real_array, shown

SHORTEST, LONGEST = 0.5, 10_000.0  # time constants in steps
SMALL = 256  # numbers shown; beyond them the matrix of a step costs more than it saves
CLOSEST = 1.5  # ratio of neighbouring ones; closer ones hold the same, and their coordinates would be rounding errors
IMAGINED = 64  # steps before the first output
FILLED = 20  # longest time constants, after which e^-20 is left of what was before
TABLE = 1_000  # ages of which the factors are worked out once


class Memory:
    """Exact first-order filters of signals, in coordinates that are uncorrelated and as large as the signals.

    For each output y and time constant tau the low-pass z' = (y - z) / tau is integrated exactly, y being linear
    between samples. What counts is w = y - z, which is 0 where y rests, whatever its value:
    w_k+1 = decay w_k + rise (y_k+1 - y_k). For each input u and time constant of inputs it is the low-pass
    v' = (u - v) / tau itself, u being held.

    Of what was before the first output nothing is known. y is taken to have rested until 64 steps before it, and then
    to have changed as fast as since, in the mean as each filter weighs it. At the age of k steps this multiplies w by
    (1 - decay^(k + 64)) / (1 - decay^k). No input is taken to have acted.

    Of a slow signal all w say nearly the same, tau times its rate. So the memory holds combinations of them: the
    slowest first, and of each faster one what slower ones do not tell. They are uncorrelated and as large as y if y
    wanders as an Ornstein-Uhlenbeck process does, with a correlation time of which only the order is known, from
    twice the shortest time constant to eight times the longest. Nothing is fitted to data. White noise on y is
    amplified at most threefold in the end. It is amplified more at first, where there is little to tell a rate from:
    by the default time constants 22-fold in the first step, and fourfold in the fifth.

    Shapes: ``time_constants`` of length m, ``input_time_constants`` of length k, ``decay``, ``rise`` (m,), ``mixing``
    (m, m), ``input_decay`` (k,).
    """

    def __init__(
        self, ny: int, nu: int, *, time_constants: Sequence[float], input_time_constants: Sequence[float]
    ) -> None:
        self.time_constants = output_time_constants("time_constants", time_constants)
        self.input_time_constants = _time_constants("input_time_constants", input_time_constants)
        m = len(self.time_constants)
        tau = np.array([*self.time_constants, *self.input_time_constants])
        linear = LinearFilter(-np.diag(1 / tau), 1 / tau[:, None], dt=1.0, nu=1)
        decay = linear.transition.diagonal()[: len(tau)].copy()
        self.decay, self.input_decay, self.rise = decay[:m], decay[m:], 1 - linear.late_y[:m, 0]
        self.mixing = _mixing(self.time_constants, self.decay, self.rise)
        self._ny, self._nu = ny, nu
        self._filled = FILLED * math.ceil(self.time_constants[-1])
        self._factors = np.array([_with_past(self.decay, age) for age in range(min(self._filled, TABLE))])
        self._row: np.ndarray | None = None  # [y, w, v] of a single one
        # It advances by one product, where it is small: every call of NumPy would be felt.
        self._matrices = self._products() if self.size <= SMALL else None
        self._y: np.ndarray | None = None  # of a batch, (n, ny); it has w, (m, n, ny), and v, (k, n, nu)

    def _products(self) -> tuple[np.ndarray, np.ndarray]:
        """What [y, w, v, next y, u] of a single row are multiplied by for its next state, and that to be shown."""
        ny, nu, size, m = self._ny, self._nu, self.size, len(self.decay)
        y, w, v = slice(ny), slice(ny, ny + m * ny), slice(ny + m * ny, size)
        y_next, u = slice(size, size + ny), slice(size + ny, size + ny + nu)
        update, combine = np.zeros((size + ny + nu, size)), np.eye(size)
        update[w, w] = np.diag(np.repeat(self.decay, ny))
        update[v, v] = np.diag(np.repeat(self.input_decay, nu))
        update[y_next, y] = np.eye(ny)
        update[y_next, w] = np.kron(self.rise, np.eye(ny))
        update[y, w] = -update[y_next, w]
        update[u, v] = np.kron(1 - self.input_decay, np.eye(nu))
        combine[w, w] = np.kron(self.mixing.T, np.eye(ny))
        return update, combine

    @property
    def size(self) -> int:
        """How many numbers are shown."""
        return self._ny * (1 + len(self.time_constants)) + self._nu * len(self.input_time_constants)

    def bounds(
        self,
        low: np.ndarray,
        high: np.ndarray,
        u_low: np.ndarray,
        u_high: np.ndarray,
        *,
        change: np.ndarray | float = np.inf,
    ) -> np.ndarray:
        """The least and the largest that can be shown at any age, (2, size); the worst signals come within 1 %."""
        ages = {*range(1, min(64, self._filled)), *np.geomspace(64, max(64, self._filled), 64).astype(int).tolist()}
        with np.errstate(under="ignore"):
            weights = self.rise * self.decay ** np.arange(max(ages))[:, None]
            reach, path = 1.002 * np.max([self._reach(weights[:age]) for age in ages], axis=0)  # of ages between, too
        of_outputs = np.minimum(np.outer(reach, high - low), np.outer(path, np.broadcast_to(change, low.shape))).ravel()
        of_inputs = np.tile([np.minimum(u_low, 0.0), np.maximum(u_high, 0.0)], len(self.input_decay))  # 0 at first
        return np.hstack([[low, high], [-of_outputs, of_outputs], of_inputs])

    def _reach(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far outputs from 0 to 1 can move coordinates, and outputs that change by 1 in each step.

        w weighs their changes by the weights, the latest first.
        """
        of_changes = self.mixing @ (weights * _with_past(self.decay, len(weights))).T
        within = np.maximum(np.diff(of_changes, prepend=0.0, append=0.0), 0.0).sum(1)
        return within, np.abs(of_changes).sum(1)

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """Forget all, as if outputs (ny,) or (n, ny) had rested at ``y0`` and no input had acted."""
        if y0.ndim == 1:
            if self._matrices is None:
                return self.reset(y0[None])[0]
            self._row, self._row_age = np.zeros(self.size), 0
            self._row[: self._ny] = y0
            return self._row.astype(np.float32)
        self._y, self._ages = y0.copy(), np.zeros(len(y0), dtype=int)
        self._w = np.zeros((len(self.decay), *y0.shape))
        self._spare = np.empty_like(self._w)  # to find new memory at each step costs as much as to fill it
        self._v = np.zeros((len(self.input_decay), len(y0), self._nu))
        return self.shown()

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Forget the past in rows (n,) of a batch, whose first outputs are ``y0`` (number of True in rows, ny)."""
        if self._y is None:
            raise RuntimeError("reset all environments before some of them")
        self._y[rows] = y0
        self._w[:, rows] = self._v[:, rows] = self._ages[rows] = 0
        return self.shown(rows)

    def advance(self, y: np.ndarray, u: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Take in the next outputs, (ny,) or (n, ny), and the inputs, (nu,) or (n, nu), that led to them."""
        if y.ndim == 1:
            if self._row is None:
                return self.advance(y[None], u[None])[0]
            update, combine = self._matrices  # type: ignore[misc]  # there are some, where there is a row
            self._row = np.concatenate((self._row, y, u)) @ update
            self._row_age += 1
            row, age, ny = self._row, self._row_age, self._ny
            if age < self._filled:
                factors = self._factors[age] if age < TABLE else _with_past(self.decay, age)
                row = row.copy()
                row[ny : ny + ny * len(factors)] *= factors.repeat(ny)
            return (row @ combine).astype(np.float32)
        if self._y is None:
            raise RuntimeError("reset the environment before its first step")
        decay, input_decay = self.decay[:, None, None], self.input_decay[:, None, None]
        if rows is not None:
            y = np.where(rows[:, None], y, self._y)
            decay, input_decay = (np.where(rows[:, None], kept, 1.0) for kept in (decay, input_decay))
        change = y - self._y
        self._w *= decay
        for w, rise in zip(self._w, self.rise):
            w += rise * change
        self._v += (1 - input_decay) * (u - self._v)
        self._y[:] = y
        self._ages += 1 if rows is None else rows
        return self.shown()

    def shown(self, rows: np.ndarray | None = None) -> np.ndarray:
        """What is shown of a batch, or of its rows, as things stand: (n, size), or (number of True in rows, size)."""
        w, coordinates = self._w, self._spare
        if (self._ages < self._filled).any():
            ages = np.minimum(self._ages, self._filled - 1)
            factors = self._factors[ages].T if ages.max() < TABLE else _with_past(self.decay[:, None], ages)
            w = w * factors[:, :, None]
        np.matmul(self.mixing, w.reshape(len(w), -1), out=coordinates.reshape(len(w), -1))
        parts = [self._y, *coordinates, *self._v]
        if rows is not None:
            parts = [part[rows] for part in parts]
        return np.concatenate(parts, axis=-1, dtype=np.float32)


def _with_past(decay: np.ndarray, age: int | np.ndarray) -> np.ndarray:
    """What filters are multiplied by at an age in steps."""
    with np.errstate(under="ignore"):
        return (1 - decay ** (age + IMAGINED)) / (1 - decay ** np.maximum(age, 1))  # they are 0 at the age 0


def _mixing(time_constants: Sequence[float], decay: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Gram's and Schmidt's, from the slowest w on, for the mean covariance of w over correlation times of y."""
    covariance = np.zeros((len(decay), len(decay)))
    for correlation in np.geomspace(2 * time_constants[0], 8 * time_constants[-1], 6):
        forgotten = -math.expm1(-1 / correlation)  # of y, whose variance is 1, in a step
        with_y = (
            rise * forgotten / (1 - decay * (1 - forgotten))
        )  # E[w y], and E[w (y_k+1 - y_k)] is -forgotten times it
        crossed = np.outer(decay * with_y, rise)
        # From w_k+1 = decay w_k + rise (y_k+1 - y_k), where E[(y_k+1 - y_k)^2] = 2 forgotten:
        covariance += forgotten * (2 * np.outer(rise, rise) - crossed - crossed.T) / (1 - np.outer(decay, decay))
    slowest_first = np.linalg.cholesky(covariance[::-1, ::-1] / 6)
    return np.linalg.inv(slowest_first)[:, ::-1].copy()


def output_time_constants(name: str, values: Any) -> tuple[float, ...]:
    """Return time constants of outputs as floats; raises ValueError if they are not as :class:`Memory` takes them."""
    found = _time_constants(name, values)
    if not found:
        raise ValueError(f"{name} must name at least one, in steps, such as (1, 2, 4, 8)")
    return found


def _time_constants(name: str, values: Any) -> tuple[float, ...]:
    """Time constants as floats, or ValueError."""
    array = real_array(name, values)
    if array.ndim != 1:
        raise ValueError(f"{name} must be a sequence of numbers of steps, such as (1, 2, 4, 8), got {shown(values)}")
    found = tuple(array.tolist())
    for value in found:
        if not SHORTEST <= value <= LONGEST:  # nor is NaN
            raise ValueError(f"{name} must be from {SHORTEST:g} to {LONGEST:,.0f} steps each, got {value:g}")
    for one, next_one in pairwise(found):
        if next_one < (1 - 1e-9) * CLOSEST * one:
            raise ValueError(
                f"{name} must rise, each at least {CLOSEST} times the one before, got {one:g} and {next_one:g}: closer "
                "ones would hold the same"
            )
    return found


__all__ = ["IMAGINED", "Memory", "output_time_constants"]
