"""How states are scaled for networks, and how their errors are weighed."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from training.config import Scaling
from training.maps.coordinates import STILL

LEAST = 0.1  # of the mean square of a scaled state, added to it: errors of smaller states are not taken relative


@dataclass(frozen=True)
class StateScale:
    """Scaled states are (x - offset) / scale. Shapes: ``offset`` (nx,), ``scale`` (nx,)."""

    offset: np.ndarray
    scale: np.ndarray
    relative: bool
    nx: int | None = None

    @classmethod
    def of(cls, x: np.ndarray, scaling: Scaling, *, nx: int | None = None) -> Self:
        """Find the scale of some states. Shapes: ``x`` (..., nx)."""
        axes = tuple(range(x.ndim - 1))
        if scaling == "relative":
            offset, scale = x.mean(axes), x.std(axes)
        else:
            low, high = x.min(axes), x.max(axes)
            offset, scale = (low + high) / 2, (high - low) / 2
        moves = scale > STILL * np.abs(x).max(axes)
        return cls(offset, np.where(moves, scale, 1.0), scaling == "relative", nx)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Scale states (..., nx)."""
        return np.asarray((x - self.offset) / self.scale)

    def weight(self, x: np.ndarray) -> np.ndarray:
        """Of the errors at states (..., nx), (...,)."""
        if not self.relative:
            return np.ones(x.shape[:-1])
        return np.asarray(1.0 / (((x / self.scale)[..., : self.nx] ** 2).mean(-1) + LEAST))
