"""Coordinates of the filter's state that a network can read."""

from dataclasses import dataclass, replace

import numpy as np

from observers import LinearFilter

# A mode of z whose variation is smaller than this part of the largest is left out: it holds rounding errors.
SMALLEST_MODE = 1e-7
STILL = 1e-12  # of a component's size: a standard deviation below it is rounding
SETTLED = np.log(1e3)  # time constants after which a filter has forgotten its start to one part in a thousand


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of z in which the signal has unit covariance and stationary noise a diagonal one.

    The components of z are nearly collinear, with variances that spread over ten orders of magnitude; a network
    in float32 cannot read them unless they are whitened.

    Shapes: ``offset`` (size,), ``whiten`` (modes, size), ``noise_gain`` (modes,).
    """

    offset: np.ndarray
    whiten: np.ndarray
    noise_gain: np.ndarray

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """Filter states (..., size) to coordinates (..., modes)."""
        return np.asarray((z - self.offset) @ self.whiten.T)


def coordinates(z: np.ndarray, noise: np.ndarray, silent: np.ndarray | None = None) -> Coordinates:
    """The coordinates for ``z`` (n, size) under ``noise`` (size, size), without the directions ``silent`` (size, k)."""
    if silent is not None and silent.size:
        telling = np.eye(len(silent)) - silent @ np.linalg.pinv(silent)
        rest = coordinates(z @ telling.T, telling @ noise @ telling.T)
        return replace(rest, whiten=rest.whiten @ telling)
    offset, scale = z.mean(0), spread(z)
    _, singular, directions = np.linalg.svd((z - offset) / scale, full_matrices=False)
    keep = singular > SMALLEST_MODE * singular[0]
    whiten = directions[keep] / singular[keep, None] * np.sqrt(len(z)) / scale
    variances, rotation = np.linalg.eigh(whiten @ noise @ whiten.T)
    return Coordinates(offset, rotation.T @ whiten, np.sqrt(np.maximum(variances, 0.0)))


def spread(z: np.ndarray) -> np.ndarray:
    """Standard deviations of a filter's states (n, size), in any units; 1 where one does not move."""
    deviation = z.std(0)
    return np.where(deviation > STILL * np.abs(z).max(0), deviation, 1.0)


def settling_time(linear: LinearFilter) -> float:
    """Time in seconds after which the filter has forgotten its start to one part in a thousand."""
    return float(SETTLED / linear.slowest)
