"""What becomes of the rows of a batch beside their simulation, in one pass where Numba is installed.

NumPy goes over a batch once for each operation, and each of them makes an array. For a thousand rows that takes several
times as long as the arithmetic.
"""

import functools
from typing import Any

import numpy as np

from observers.thresholds import MANY_ROWS


def clipped(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Values (..., width) as float32 within bounds (width,)."""
    many = values.ndim == 2 and len(values) >= MANY_ROWS and low.shape == high.shape == values.shape[1:]
    kernels = _kernels() if many else None
    if kernels is None:
        with np.errstate(over="ignore"):  # what float32 cannot hold is infinite
            out = values.astype(np.float32)
        np.maximum(out, low, out=out)
        np.minimum(out, high, out=out)
        return out
    out = np.empty(values.shape, np.float32)
    kernels["clip"](values, low, high, out)
    return out


def held(actions: np.ndarray, u_max: np.ndarray) -> np.ndarray:
    """The inputs (nu, n) that actions (n, nu) hold: cut at -1 and 1, and multiplied with the input bounds."""
    kernels = _kernels() if len(actions) >= MANY_ROWS else None
    if kernels is None:
        u = np.maximum(actions, -1.0)
        np.minimum(u, 1.0, out=u)
        return np.ascontiguousarray((u * u_max).T)
    u = np.empty(actions.shape[::-1])
    kernels["hold"](np.ascontiguousarray(actions), u_max, u)
    return u


@np.errstate(over="ignore", invalid="ignore")  # of states that have escaped; a block would take twice as long
def judged(
    x: np.ndarray, bounds: tuple[np.ndarray, np.ndarray], *, target: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which states (nx, n) are within their bounds, and what reward they earn: (n,) each."""
    kernels = _kernels() if x.shape[1] >= MANY_ROWS else None
    if kernels is None:
        low, high = (bound[:, None] for bound in bounds)
        inside = np.all((x >= low) & (x <= high), axis=0)
        deviation = x - target[:, None]
        return inside, 1.0 / (1.0 + 4.0 * (weights @ (deviation * deviation)))
    inside, reward = np.ones(x.shape[1], dtype=bool), np.zeros(x.shape[1])
    kernels["judge"](np.ascontiguousarray(x), *bounds, target, weights, inside, reward)
    return inside, reward


@functools.cache
def _kernels() -> dict[str, Any] | None:
    try:
        import numba
    except ImportError:
        return None

    @numba.njit
    def clip(values: np.ndarray, low: np.ndarray, high: np.ndarray, out: np.ndarray) -> None:
        n, width = values.shape
        for row in range(n):
            for i in range(width):
                value = np.float32(values[row, i])
                value = low[i] if value < low[i] else value
                out[row, i] = high[i] if value > high[i] else value

    @numba.njit
    def hold(actions: np.ndarray, u_max: np.ndarray, u: np.ndarray) -> None:
        n, nu = actions.shape
        for row in range(n):
            for i in range(nu):
                value = actions[row, i]
                value = -1.0 if value < -1.0 else value
                u[i, row] = (1.0 if value > 1.0 else value) * u_max[i]

    @numba.njit
    def judge(
        x: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        target: np.ndarray,
        weights: np.ndarray,
        inside: np.ndarray,
        reward: np.ndarray,
    ) -> None:
        nx, n = x.shape
        for i in range(nx):
            for row in range(n):
                deviation = x[i, row] - target[i]
                reward[row] += weights[i] * (deviation * deviation)
                inside[row] &= (low[i] <= x[i, row]) & (x[i, row] <= high[i])
        for row in range(n):
            reward[row] = 1.0 / (1.0 + 4.0 * reward[row])

    return {"clip": clip, "hold": hold, "judge": judge}


__all__ = ["clipped", "held", "judged"]
