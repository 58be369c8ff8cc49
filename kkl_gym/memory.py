"""A linear memory of sampled signals: a few numbers for each output and input summarise its past."""

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from observers import LinearFilter
from observers.checks import real_array, shown

SHORTEST, LONGEST = 0.5, 10_000.0  # limits of time constants, in steps
# Least ratio of successive time constants. Closer ones would give coordinates that are mostly rounding errors.
CLOSEST = 1.5
# The outputs are assumed to have changed over this number of steps before the first output.
IMAGINED = 64
# Up to this number of coordinates, one matrix product advances a single memory faster than several NumPy calls.
SMALL = 200
# After this multiple of the longest time constant, the past before the reset has the weight e^-20 and is neglected.
FILLED = 20
TURN = 2 * math.pi


class Memory:
    """Exact first-order filters of signals, in coordinates that are uncorrelated and as large as the signals.

    For each output y and time constant tau, the low-pass filter z' = (y - z) / tau is integrated exactly, with y linear
    between samples. The memory uses w = y - z, which tends to 0 while y is constant:
    w_k+1 = decay w_k + rise (y_k+1 - y_k). For each input u and time constant of inputs, the memory uses the low-pass
    filter v' = (u - v) / tau itself, with u held between samples.

    The past before the first output is unknown. The memory assumes that y was constant until 64 steps before the first
    output. For these 64 steps, each filter assumes the rate of change since the first output, averaged with the
    filter's weights. After k steps this assumption multiplies w by (1 - decay^(k + 64)) / (1 - decay^k). The memory
    also assumes that no input acted before the first output.

    Every w of a slow signal is nearly tau times the signal's rate, so that all w would carry the same information. The
    memory therefore returns combinations: the w of the slowest filter, then for each faster filter the part of its w
    that the slower filters do not predict. These coordinates are uncorrelated and as large as y on average over
    Ornstein-Uhlenbeck processes y with correlation times from twice the shortest time constant to eight times the
    longest. In the long run they amplify white noise on y at most threefold. At first they rest on few samples and
    amplify noise more: with the default time constants 22-fold in the first step, and fourfold in the fifth.

    If an angle is measured by its cosine and its sine, the memory filters the unwrapped angle itself. It assumes that
    the angle turns by less than half a turn from one sample to the next, and that it does not change where cosine and
    sine are both 0. Among the coordinates of each filter, those of angles come last.

    Shapes: ``angles``, indices of cosines and sines, (number of angles, 2); ``decay``, ``rise`` (m,), ``mixing``
    (m, m), ``input_decay`` (k,); outputs, inputs and the coordinates returned (..., ny), (..., nu), (..., size).
    """

    def __init__(
        self,
        ny: int,
        nu: int,
        angles: Sequence[tuple[int, int]] = (),
        *,
        time_constants: Sequence[float],
        input_time_constants: Sequence[float],
    ) -> None:
        self.time_constants = output_time_constants("time_constants", time_constants)
        self.input_time_constants = _time_constants("input_time_constants", input_time_constants)
        m = len(self.time_constants)
        tau = np.array([*self.time_constants, *self.input_time_constants])
        linear = LinearFilter(-np.diag(1 / tau), 1 / tau[:, None], dt=1.0, nu=1)
        decay = linear.transition.diagonal()[: len(tau)].copy()
        self.decay, self.input_decay, self.rise = decay[:m], decay[m:], 1 - linear.late_y[:m, 0]
        self.mixing = _mixing(self.time_constants, self.decay, self.rise)
        pairs = np.array(angles, dtype=int).reshape(-1, 2)
        self._cosines, self._sines = pairs.T
        self._others = np.setdiff1d(np.arange(ny), pairs)
        self._ny, self._nu = ny, nu
        self.size = ny + (len(self._others) + len(pairs)) * m + nu * len(self.input_decay)  # number of coordinates
        ages = np.arange(FILLED * math.ceil(self.time_constants[-1]))[:, None]
        with np.errstate(under="ignore"):
            self._with_past = (1 - self.decay ** (ages + IMAGINED)) / (1 - self.decay ** np.maximum(ages, 1))
        self._y: np.ndarray | None = None  # (..., ny); w has the shape (m, ..., signals), v (k, ..., nu)
        # For a single small memory, [signals, w, v] in one array; the separate attributes are then views of it.
        self._row: np.ndarray | None = None

    @cached_property
    def _products(self) -> tuple[np.ndarray, np.ndarray]:
        """Two matrices that multiply rows from the right.

        The first maps [signals, w, v, next signals, u] to the next [signals, w, v]; the second mixes [signals, w, v].
        """
        n, m, nu, of_inputs = len(self._signals), len(self.decay), self._nu, len(self.input_decay)
        each, rise = np.eye(n), np.kron(self.rise, np.eye(n))
        sizes = np.cumsum([n, m * n, of_inputs * nu, n, nu])
        w, v, after, u = (slice(*ends) for ends in pairwise(sizes))
        update, combine = np.zeros((sizes[-1], v.stop)), np.eye(v.stop)
        update[w, w], update[v, v] = np.diag(self.decay.repeat(n)), np.diag(self.input_decay.repeat(nu))
        update[after, :n], update[after, w], update[:n, w] = each, rise, -rise
        update[u, v] = np.kron(1 - self.input_decay, np.eye(nu))
        combine[w, w] = np.kron(self.mixing.T, each)
        return update, combine

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """Begin with outputs ``y0`` (..., ny), as if they had been constant and no input had acted."""
        self._y = y0.copy()
        self._signals = self._read(self._y, 0.0)
        self._w = np.zeros((len(self.decay), *self._signals.shape))
        self._v = np.zeros((len(self.input_decay), *y0.shape[:-1], self._nu))
        self._ages = np.zeros(y0.shape[:-1], dtype=int)
        if y0.ndim == 1 and self.size <= SMALL:
            n = len(self._signals)
            self._row = np.concatenate((self._signals, self._w.ravel(), self._v.ravel()))
            self._signals, w, v = np.split(self._row, (n, n + self._w.size))
            self._w, self._v = w.reshape(self._w.shape), v.reshape(self._v.shape)
        else:
            self._row = None
        return self.shown()

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Begin again where the mask ``rows`` (n,) is True; ``y0`` (number of True, ny) are the first outputs there."""
        if self._y is None:
            raise RuntimeError("reset all environments before some of them")
        self._y[rows], self._signals[rows] = y0, self._read(y0, 0.0)
        self._w[:, rows] = self._v[:, rows] = self._ages[rows] = 0
        return self.shown(rows)

    def advance(self, y: np.ndarray, u: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Add the next outputs (..., ny), and the inputs (..., nu) that led to them, in some rows or in all."""
        if self._row is not None:
            self._y, self._ages = y.copy(), self._ages + 1
            signals = self._read(y, self._signals[len(self._others) :])
            np.concatenate((self._row, signals, u)).dot(self._products[0], out=self._row)
            return self.shown()
        self._check_begun()
        of_filters = (-1, *(1,) * y.ndim)
        decay, rise, input_decay = (each.reshape(of_filters) for each in (self.decay, self.rise, self.input_decay))
        if rows is not None:
            y = np.where(rows[:, None], y, self._y)  # type: ignore[arg-type]
            decay, input_decay = (np.where(rows[:, None], kept, 1.0) for kept in (decay, input_decay))
        self._y = y.copy()
        signals = self._read(self._y, self._signals[..., len(self._others) :])
        self._w *= decay
        self._w += rise * (signals - self._signals)
        self._v += (1 - input_decay) * (u - self._v)
        self._signals = signals
        self._ages = self._ages + (1 if rows is None else rows)
        return self.shown()

    def _check_begun(self) -> None:
        if self._y is None:
            raise RuntimeError("reset the environment before its first step")

    def _read(self, y: np.ndarray, before: np.ndarray | float) -> np.ndarray:
        """Return the signals to filter: first the outputs that are no cosine or sine of an angle, then the angles."""
        if not len(self._cosines):
            return y
        angles = turned(y.take(self._cosines, -1), y.take(self._sines, -1), before)
        return np.concatenate((y.take(self._others, -1), angles), axis=-1)

    def shown(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return outputs, their memory and the memory of the inputs, (..., size), in all rows or some."""
        self._check_begun()
        w, filled = self._w, len(self._with_past)
        if self._row is not None:
            row, n = self._row, len(self._signals)
            if self._ages < filled:
                row = row.copy()
                row[n : n + w.size] *= self._with_past[self._ages].repeat(n)
            out = row.dot(self._products[1])
            if len(self._cosines):
                out = np.concatenate((self._y, out[n:]))  # type: ignore[arg-type]
            return out.astype(np.float32)
        if (self._ages < filled).any():
            w = w * np.moveaxis(self._with_past[np.minimum(self._ages, filled - 1)], -1, 0)[..., None]
        parts = [self._y, *(self.mixing @ w.reshape(len(w), -1)).reshape(w.shape), *self._v]
        if rows is not None:
            parts = [part[rows] for part in parts]
        return np.concatenate(parts, axis=-1, dtype=np.float32)


def turned(cosines: np.ndarray, sines: np.ndarray, before: np.ndarray | float) -> np.ndarray:
    """Return unwrapped angles in rad, within half a turn of ``before``; ``before`` where cosine and sine are both 0."""
    angles = np.arctan2(sines, cosines)
    nearest = angles - TURN * np.rint((angles - before) / TURN)
    return np.where((cosines == 0) & (sines == 0), before, nearest)


def _mixing(time_constants: Sequence[float], decay: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Return the matrix that orthonormalises w, slowest first, under a covariance averaged over correlation times."""
    covariance = np.zeros((len(decay), len(decay)))
    for correlation in np.geomspace(2 * time_constants[0], 8 * time_constants[-1], 6):
        # y has the variance 1, and the autocorrelation 1 - forgotten after a step.
        forgotten = -math.expm1(-1 / correlation)
        # This is E[w y], and E[w (y_k+1 - y_k)] is -forgotten times E[w y].
        with_y = rise * forgotten / (1 - decay * (1 - forgotten))
        crossed = np.outer(decay * with_y, rise)
        # From w_k+1 = decay w_k + rise (y_k+1 - y_k), where E[(y_k+1 - y_k)^2] = 2 forgotten:
        covariance += forgotten * (2 * np.outer(rise, rise) - crossed - crossed.T) / (1 - np.outer(decay, decay))
    slowest_first = np.linalg.cholesky(covariance[::-1, ::-1] / 6)
    return np.linalg.inv(slowest_first)[:, ::-1].copy()


def output_time_constants(name: str, values: Any) -> tuple[float, ...]:
    """Return time constants of outputs as floats; ValueError unless :class:`Memory` takes them."""
    found = _time_constants(name, values)
    if not found:
        raise ValueError(f"{name} must hold at least one number of steps, such as (1, 2, 4, 8)")
    return found


def _time_constants(name: str, values: Any) -> tuple[float, ...]:
    """Return time constants as floats, or raise ValueError."""
    array = real_array(name, values)
    if array.ndim != 1:
        raise ValueError(f"{name} must be a sequence of numbers of steps, such as (1, 2, 4, 8), got {shown(values)}")
    found = tuple(array.tolist())
    for value in found:
        if not SHORTEST <= value <= LONGEST:  # also true for NaN
            raise ValueError(f"{name} must be from {SHORTEST:g} to {LONGEST:,.0f} steps each, got {value:g}")
    for one, next_one in pairwise(found):
        if next_one < (1 - 1e-9) * CLOSEST * one:
            raise ValueError(
                f"{name} must rise, each at least {CLOSEST} times the one before, got {one:g} and {next_one:g}: closer "
                "ones would give the same memory"
            )
    return found


__all__ = ["IMAGINED", "Memory", "output_time_constants"]
