"""Training trajectories by chunks, for observers that are trained by truncated back-propagation through time."""

from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from examples.research.methods.base import Data
from kkl_gym.system import System
from training.evaluation.levels import Level
from training.maps.networks import tensor

FAINT_NOISE = 0.01  # of the system's own level: the feature of noise is linear below it and logarithmic above
ROUNDING = 1e-3  # of a state's standard deviation, below which the length of an error is rounded off


class Chunk(NamedTuple):
    """The next samples of every row.

    Shapes: ``fresh`` (rows,), ``y`` (samples, rows, ny), ``noise`` (rows, ny), ``recorded`` (samples, rows),
    ``x`` (number recorded, nx).
    """

    fresh: torch.Tensor
    y: torch.Tensor
    noise: torch.Tensor
    recorded: torch.Tensor
    x: torch.Tensor


class Chunks(nn.Module):
    """Rows that each follow a trajectory from its start, for a random part of it, and then begin another one.

    Rows are of all ages at any time, so that every batch has transients and settled motion. Half of the trajectories
    carry no noise, the others a level up to the system's own. The rows' places are buffers, part of a checkpoint.

    Shapes: ``measurement_noise`` of length ny, ``x_offset``, ``x_scale`` (nx,), ``y_offset``, ``y_scale`` (ny,).
    """

    def __init__(
        self, data: Data, measurement_noise: Level, *, samples: int, rows: int, device: torch.device | None = None
    ) -> None:
        super().__init__()
        device = device or torch.device("cpu")
        self.x_offset, self.x_scale = data.x.mean((0, 1)), varying(data.x.std((0, 1)))
        self.y_offset, self.y_scale = data.y.mean((0, 1), dtype=float), varying(data.y.std((0, 1), dtype=float))
        self._samples = min(samples, len(data.y))
        self._y, self._x = tensor(data.y, device), tensor((data.x - self.x_offset) / self.x_scale, device)
        self._noise = tensor(np.broadcast_to(measurement_noise, data.y.shape[-1:]), device)
        number = np.full(len(data.y), -1)
        number[data.ages] = np.arange(len(data.ages))
        self._number = torch.as_tensor(number, device=device)
        self._steps = torch.arange(self._samples, device=device)[:, None]
        counts = torch.zeros(rows, dtype=torch.long, device=device)
        self.register_buffer("trajectory", counts)
        self.register_buffer("age", counts.clone())
        self.register_buffer("end", counts.clone())  # at once, so that all rows begin
        self.register_buffer("level", torch.zeros(rows, 1, device=device))
        self.trajectory: torch.Tensor
        self.age: torch.Tensor
        self.end: torch.Tensor
        self.level: torch.Tensor

    def draw(self, generator: torch.Generator) -> Chunk:
        """Go on by one chunk."""
        (length, trajectories, _), rows, device = self._y.shape, len(self.age), self._y.device
        drawn = torch.randint(trajectories, (rows,), generator=generator, device=device)
        end = torch.randint(1, length + 1, (rows,), generator=generator, device=device)
        level = (torch.rand((rows, 1), generator=generator, device=device) * 2 - 1).clamp(min=0.0)
        fresh = (self.age >= self.end) | (self.age + self._samples > length)
        self.age.masked_fill_(fresh, 0)
        self.trajectory.copy_(torch.where(fresh, drawn, self.trajectory))
        self.end.copy_(torch.where(fresh, end, self.end))
        self.level.copy_(torch.where(fresh[:, None], level, self.level))
        ages = self.age + self._steps
        y = self._y[ages, self.trajectory]
        y = y + self.level * self._noise * torch.randn(y.shape, generator=generator, device=device)
        number = self._number[ages]
        recorded = number >= 0
        x = self._x[number[recorded], self.trajectory.expand_as(number)[recorded]]
        self.age.add_(self._samples)
        return Chunk(fresh, y, level_feature(self.level.expand(-1, y.shape[-1])), recorded, x)


def varying(scale: np.ndarray) -> np.ndarray:
    """Standard deviations as scales: 1 where nothing varies."""
    return np.where(scale > 0, scale, 1.0)


def level_feature(level: torch.Tensor) -> torch.Tensor:
    """The networks' input for levels of noise, in multiples of the system's own."""
    return torch.asinh(level / FAINT_NOISE)


def noise_feature(noise: Level, system: System) -> torch.Tensor:
    """The same, (ny,), of standard deviations in the outputs' units, cut at the highest in training."""
    own = np.broadcast_to(np.asarray(system.measurement_noise, dtype=float), (system.ny,))
    level = np.minimum(np.divide(noise, own, out=np.zeros(system.ny), where=own > 0), 1.0)
    return level_feature(torch.as_tensor(level, dtype=torch.float32))


def error(differences: torch.Tensor) -> torch.Tensor:
    """Mean length of the errors of scaled estimates, (n, nx), rounded off near zero; zero if there are none.

    The first samples, when no observer can know the state, would dominate a mean of squares.
    """
    lengths = (differences.square().sum(-1) + ROUNDING**2).sqrt()
    return lengths.sum() / max(len(lengths), 1)
