"""Training of T_inv: batches of (z, x), from motions or from z = T(x), and the network's loss."""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import nn

from observers import MLP, ForwardMap, InverseMap, LinearFilter
from training.config import Config
from training.maps.coordinates import (
    StateScale,
    coordinates,
    noise_covariance,
    root,
    settling_time,
    stationary_covariance,
)
from training.maps.networks import Network, compiled, tensor
from training.trajectories.motions import Pairs

MEASUREMENT_NOISE_UNIT = 0.04  # unit in the noise feature log(1 + sigma_v / unit), in multiples of the default noise
AGE_UNIT = 5  # unit in the age feature log(1 + t / unit), in samples
# With several outputs, the share of samples in which all outputs have the same fraction of their largest noise levels.
ALIKE = 0.5
SAMPLES = 100_000  # largest number of samples of z that determine its coordinates
PROCESS_NOISE_UNIT = 0.1  # unit in the process noise feature log(1 + level / unit), in multiples of the highest level


class Batch(NamedTuple):
    """Samples to which the inverse is fitted; ``cell`` is the index of a sample's group of similar age and noise."""

    inputs: torch.Tensor
    x: torch.Tensor
    weight: torch.Tensor
    cell: torch.Tensor


class Sampler(Protocol):
    """Draws batches for T_inv, each sample in one of ``cells`` groups, and makes the inverse map of a network."""

    cells: int = 1
    kinds_of_plant: int = 1  # 2 if motions with the system's own parameters have separate cells
    parameters: int = 0  # number of estimated parameters, which follow the states in x
    _map: dict[str, Any]

    def __call__(self, generator: torch.Generator) -> Batch:
        """Draw a batch."""

    def inverse_map(self, mlp: MLP) -> InverseMap:
        """Make the inverse map of a network that was trained on these batches."""
        return InverseMap(mlp=mlp, **self._map)


class TrajectorySampler(Sampler):
    """Draws batches along trajectories, at all ages since reset and noise levels up to ``measurement_noise_max``.

    Noise is added to noise-free z, with the covariance of the filter's response to measurement noise at each age. A
    network that fits these data in the mean square approximates the conditional mean of x.

    The least possible errors differ by orders of magnitude between ages and noise levels. Samples therefore fall into
    ``cells`` of similar age and noise, and the loss divides a sample's square error by the recent mean of its cell.
    Motions with the system's own parameters, whose errors can be smaller, have separate cells.

    Shapes: ``error`` (size, size), z's error covariance for a learned T; ``silent`` (size, k), z's ignored directions.
    """

    AGES_PER_BATCH = 32
    LEVELS = 6  # cells by noise level, besides the one without noise
    AGE_CELLS = 8
    PROCESS_CELLS = 3  # no, weak and strong process noise

    def __init__(
        self,
        data: Pairs,
        linear: LinearFilter,
        config: Config,
        *,
        device: torch.device,
        measurement_noise: float | tuple[float, ...] = 0.5,
        process_noise_max: float = 0.0,
        parameters: int = 0,
        error: np.ndarray | None = None,
        silent: np.ndarray | None = None,
    ) -> None:
        (m, n, size), ny = data.z.shape, linear.B.shape[1]
        largest = np.broadcast_to(np.asarray(config.measurement_noise_max, dtype=float), ny)
        unit = MEASUREMENT_NOISE_UNIT * np.where(measurement_noise, measurement_noise, largest / 2)
        rows = np.random.default_rng(0).permutation(m * n)[:SAMPLES]
        each = stationary_covariance(linear)
        together = np.einsum("j,jab->ab", (largest / largest.max()) ** 2, each)
        whitened = coordinates(data.z.reshape(m * n, size)[rows], together, silent)
        gain, whiten = whitened.noise_gain, whitened.whiten
        gains = np.sqrt(np.maximum(np.einsum("ma,jab,mb->jm", whiten, each, whiten), 0.0)) if ny > 1 else gain
        scale = StateScale.of(data.x, config.scaling, nx=data.x.shape[-1] - parameters)
        age_unit, age_max = AGE_UNIT * linear.dt, float(min(data.ages[-1] * linear.dt, settling_time(linear)))
        named = {"z_y": True, "z_u": linear.nu, "measurement_noise": True, "process_noise": process_noise_max}
        self._map = {
            "features": (*(name for name, used in named.items() if used), "age"),
            "z_offset": whitened.offset,
            "whiten": whiten,
            "noise_gain": gains,
            "x_offset": scale.offset,
            "x_scale": scale.scale,
            "measurement_noise_unit": _float_or_tuple(unit),
            "measurement_noise_max": _float_or_tuple(largest),
            "process_noise_unit": PROCESS_NOISE_UNIT * process_noise_max or 1.0,
            "process_noise_max": process_noise_max or math.inf,
            "age_unit": age_unit,
            "age_max": age_max,
        }
        self.parameters = parameters
        self._config, self._per_age = config, config.batch // self.AGES_PER_BATCH
        self._modes = torch.empty((m, n, len(gain)), device=device)
        for i in range(m):
            self._modes[i] = tensor(whitened(data.z[i]), device)
        self._x, self._weight = tensor(scale(data.x), device), tensor(scale.weight(data.x), device)
        self._gain, self._gains = tensor(gain, device), tensor(np.atleast_2d(gains)[:, None], device)
        self._level_max, self._level_unit = (tensor(values[:, None], device) for values in (largest, unit))
        # Noise is drawn in units of the stationary noise, so that its covariances are well conditioned.
        relative = whiten / np.where(gain > 0, gain, 1.0)[:, None]
        saturated = np.minimum(data.ages, int(np.ceil(2 * settling_time(linear) / linear.dt)))
        self._noise_root = tensor(root(relative @ noise_covariance(linear, saturated) @ relative.T), device)
        self._error_root = None if error is None else tensor(root(whiten @ error @ whiten.T), device)
        self._age = torch.log1p(tensor(data.ages * linear.dt, device).clamp(max=age_max) / age_unit)
        position = np.log1p(data.ages) / np.log1p(data.ages[-1])
        age_cell = np.minimum((position * self.AGE_CELLS).astype(int), self.AGE_CELLS - 1)
        self._age_cell = torch.as_tensor(age_cell, device=device)
        trajectory_cell, self._trajectory_cells = np.zeros(n, int), 1
        self._process: torch.Tensor | None = None
        if process_noise_max:
            part = data.process_noise / process_noise_max
            self._process = tensor(np.log1p(part / PROCESS_NOISE_UNIT), device)
            trajectory_cell, self._trajectory_cells = (part > 0).astype(int) + (part > 0.5), self.PROCESS_CELLS
        if data.nominal is not None:  # motions with the system's own parameters have separate cells
            trajectory_cell, self.kinds_of_plant = 2 * trajectory_cell + data.nominal, 2
            self._trajectory_cells *= 2
        self._trajectory_cell = torch.as_tensor(trajectory_cell, device=device)
        self.cells = self.AGE_CELLS * (1 + self.LEVELS) * self._trajectory_cells

    def __call__(self, generator: torch.Generator) -> Batch:
        """Draw a batch."""
        device = self._x.device
        m, n, _ = self._x.shape
        ages = torch.randint(m, (self.AGES_PER_BATCH, 1), generator=generator, device=device)
        shape, ny = (self.AGES_PER_BATCH, self._per_age), len(self._level_max)
        rows = torch.randint(n, shape, generator=generator, device=device)
        position, level = self._draw_levels(generator)
        white = torch.randn((shape[0], ny, shape[1], self._noise_root.shape[-1]), generator=generator, device=device)
        noise = white @ self._noise_root[ages[:, 0]].mT
        modes = self._modes[ages, rows] + (level[..., None] * self._gain * noise).sum(1)
        if self._error_root is not None:
            modes = modes + torch.randn(modes.shape, generator=generator, device=device) @ self._error_root.mT
        modes = modes / (1.0 + ((level[..., None] * self._gains) ** 2).sum(1))
        process = [] if self._process is None else [self._process[rows][..., None]]
        age = self._age[ages][..., None].expand(*shape, 1)
        inputs = torch.cat([modes, torch.log1p(level / self._level_unit).mT, *process, age], -1)
        level_cell = 1 + (position.mean(1) * self.LEVELS).long().clamp(0, self.LEVELS - 1)
        level_cell = torch.where((level > 0).any(1), level_cell, 0)
        cell = self._age_cell[ages] * (1 + self.LEVELS) + level_cell
        cell = cell * self._trajectory_cells + self._trajectory_cell[rows]
        batch = self.AGES_PER_BATCH * self._per_age
        return Batch(
            inputs.reshape(batch, -1),
            self._x[ages, rows].reshape(batch, -1),
            self._weight[ages, rows].reshape(batch),
            cell.reshape(batch),
        )

    def _draw_levels(self, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw noise levels over two decades; return positions in these, 0 to 1, and levels (ages, ny, samples)."""
        shape = (self.AGES_PER_BATCH, len(self._level_max), self._per_age)
        quiet = self._config.noise_free_share
        position = (torch.rand(shape, generator=generator, device=generator.device) - quiet) / (1 - quiet)
        if shape[1] > 1:
            alike = torch.rand(position[:, :1].shape, generator=generator, device=generator.device) < ALIKE
            position = torch.where(alike, position[:, :1], position)
        loud = position > 0
        position = position.clamp(min=0.0) ** (1 / self._config.high_noise_emphasis)
        level = self._level_max * 100 ** (position - 1)
        return position, torch.where(loud, level, torch.zeros_like(level))


def _float_or_tuple(values: np.ndarray) -> float | tuple[float, ...]:
    """Return a number for one output or a tuple for several, as inverse maps hold them."""
    return tuple(values.tolist()) if len(values) > 1 else float(values[0])


class ForwardMapSampler(Sampler):
    """Draws batches from the paper's second data set S_2 (sec. 5.2): points x with z = T(x), without transients.

    The filter's z differs from T(x) by the error of T, which an inverse fitted to T(x) alone would magnify by its
    Lipschitz constant (paper, lemma R-eta-bound). Gaussian noise with the covariance of T's error, measured on the
    training data of T, is therefore added to T(x), and each coordinate is shrunk to its linear conditional mean.

    Shapes: ``error`` (nz, nz), the covariance of T's error; ``points`` (n, nx).
    """

    def __init__(
        self, T: ForwardMap, error: np.ndarray, config: Config, *, points: np.ndarray, device: torch.device
    ) -> None:
        scale = StateScale.of(points, config.scaling)
        self._x, self._weight = tensor(scale(points), device), tensor(scale.weight(points), device)
        z = np.concatenate([T(part) for part in np.array_split(points, 1 + len(points) // SAMPLES)])
        some = np.random.default_rng(0).permutation(len(z))[:SAMPLES]
        whitened = coordinates(z[some], error)
        self._modes, self._batch = tensor(whitened(z), device), config.batch
        self._blur = tensor(whitened.noise_gain, device)
        self._map = {
            "features": ("z_y",),
            "z_offset": whitened.offset,
            "whiten": whitened.whiten / (1.0 + whitened.noise_gain**2)[:, None],
            "noise_gain": np.zeros(len(whitened.noise_gain)),
            "x_offset": scale.offset,
            "x_scale": scale.scale,
        }

    def __call__(self, generator: torch.Generator) -> Batch:
        """Draw a batch."""
        device = self._x.device
        rows = torch.randint(len(self._x), (self._batch,), generator=generator, device=device)
        modes = self._modes[rows]
        modes = modes + self._blur * torch.randn(modes.shape, generator=generator, device=device)
        cell = torch.zeros(len(rows), dtype=torch.long, device=device)
        return Batch(modes / (1.0 + self._blur**2), self._x[rows], self._weight[rows], cell)


class InverseProblem(nn.Module):
    """An inverse network's training problem: its loss, with a running mean square error for each cell."""

    def __init__(self, network: Network, sampler: Sampler, device: torch.device) -> None:
        super().__init__()
        self.network = network
        self.sampler = sampler
        cells = sampler.cells * (2 if sampler.parameters else 1)
        self.error = nn.Buffer(torch.ones(cells, device=device))
        self.visited = nn.Buffer(torch.zeros(cells, dtype=torch.bool, device=device))
        self._risk = compiled(self.risk, device)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Draw a batch; return its loss and the geometric mean of the cells' running errors, see :meth:`risk`."""
        risk, error = self._risk(*self.sampler(generator))
        return {"loss": risk, "error": error}

    def risk(
        self, inputs: torch.Tensor, x: torch.Tensor, weight: torch.Tensor, cell: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss (square errors divided by their cells' running means) and the cells' geometric mean error."""
        apart, nx = (self.network(inputs) - x) ** 2, x.shape[1] - self.sampler.parameters
        square = weight * apart[:, :nx].mean(-1)
        if self.sampler.parameters:  # in separate cells, as parameters can be hard to estimate where states are easy
            square = torch.cat([square, apart[:, nx:].mean(-1)])
            # Separate cells would give small errors of nominal plants more weight: others would seem nominal, too.
            cell = torch.cat([cell, self.sampler.cells + cell // self.sampler.kinds_of_plant])
        detached = square.detach()
        count = torch.zeros_like(self.error).index_add_(0, cell, torch.ones_like(detached))
        mean = torch.zeros_like(self.error).index_add_(0, cell, detached) / count.clamp(min=1.0)
        keep = torch.where(count > 0, 0.99, 1.0)
        self.error.mul_(keep).add_((1 - keep) * mean)
        self.visited.logical_or_(count > 0)
        # The mean leaves out cells that have not had any data.
        error = (torch.where(self.visited, self.error.log(), 0.0).sum() / self.visited.sum()).exp().sqrt()
        return (square / self.error[cell]).mean(), error
