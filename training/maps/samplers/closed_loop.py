"""Batches in which trajectories under a controller join the others."""

import numpy as np
import torch

from observers import InverseMap, LinearFilter
from training.maps.networks import Network, tensor
from training.maps.samplers.batch import Batch
from training.maps.samplers.trajectory import TrajectorySampler
from training.trajectories.closed_loop import ClosedLoop


class ClosedLoopSampler:
    """Batches half from open-loop trajectories, half from closed-loop ones with the noise that these already hold."""

    def __init__(self, open_loop: TrajectorySampler, data: ClosedLoop, *, dt: float, device: torch.device) -> None:
        self.open_loop, self.coordinates = open_loop, open_loop.coordinates
        self.parameters, self.kinds_of_plant = open_loop.parameters, open_loop.kinds_of_plant
        level, gain = data.measurement_noise, np.atleast_2d(open_loop.noise_gain)
        shrink = 1.0 + ((level[..., None] * gain) ** 2).sum(1)
        self._modes = tensor(open_loop.coordinates(data.z) / shrink, device)
        self._x = tensor(open_loop.scale(data.x), device)
        self._level = tensor(np.log1p(level / open_loop.measurement_noise_unit), device)
        self._age = tensor(np.log1p(np.minimum(data.ages * dt, open_loop.age_max) / open_loop.age_unit), device)
        self._weight = tensor(open_loop.scale.weight(data.x), device)
        self._age_cell = open_loop.age_cell(data.ages, device)
        position = np.log10(np.maximum(level / open_loop.measurement_noise_max, 1e-9)) / 2 + 1
        position = np.maximum(position, 0.0).mean(-1)  # over two decades, as there
        level_cell = np.where(level.any(-1), 1 + np.minimum(position * open_loop.LEVELS, open_loop.LEVELS - 1), 0)
        self._level_cell = torch.as_tensor(level_cell.astype(int), device=device)
        self._process_cell = torch.zeros_like(self._level_cell)
        if open_loop.process_noise_max:
            self._process, self._process_cell = open_loop.process_conditions(data.process_noise, device)
        self._nominal_cell = open_loop.nominal_cell(data, device)
        self.cells = 2 * open_loop.cells

    def __call__(self, generator: torch.Generator) -> Batch:
        """One batch."""
        inputs, x, weight, cell = self.open_loop(generator)
        m, n, _ = self._x.shape
        half, device = len(x) // 2, self._x.device
        ages = torch.randint(m, (half,), generator=generator, device=device)
        rows = torch.randint(n, (half,), generator=generator, device=device)
        conditions = [self._level[rows], self._age[ages][:, None]]
        if self.open_loop.process_noise_max:
            conditions.insert(1, self._process[rows][:, None])
        closed = torch.cat([self._modes[ages, rows], *conditions], -1)
        closed_cell = self.open_loop.cell(
            self._age_cell[ages], self._level_cell[rows], self._process_cell[rows], self._nominal_cell[rows]
        )
        return Batch(
            torch.cat([inputs[:half], closed]),
            torch.cat([x[:half], self._x[ages, rows]]),
            torch.cat([weight[:half], self._weight[ages, rows]]),
            torch.cat([cell[:half], self.open_loop.cells + closed_cell]),
        )

    def inverse_map(self, network: Network, linear: LinearFilter) -> InverseMap:
        """The map that a network trained on these batches makes."""
        return self.open_loop.inverse_map(network, linear)
