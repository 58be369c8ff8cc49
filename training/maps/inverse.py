"""The inverse T_inv: batches along motions, in closed loop or of T(x), and what its training minimises on them."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from observers import InverseMap, LinearFilter
from training.config import Scaling
from training.maps.coordinates import (
    StateScale,
    coordinates,
    noise_covariance,
    root,
    settling_time,
    stationary_covariance,
)
from training.maps.forward import TensorMap
from training.maps.networks import Network, compiled, tensor
from training.trajectories.closed_loop import ClosedLoop
from training.trajectories.motions import ALIKE, Pairs

MEASUREMENT_NOISE_UNIT = 0.04  # of the usual level, in the noise feature log(1 + sigma_v / unit)
AGE_UNIT = 5  # samples, in the age feature log(1 + t / unit)
SAMPLES = 100_000  # of z, from which coordinates are found
PROCESS_NOISE_UNIT = 0.1  # of the highest level, in the process noise feature log(1 + level / unit)


class Batch(NamedTuple):
    """Samples on which the inverse is fitted, with the weight and the cell of each."""

    inputs: torch.Tensor
    x: torch.Tensor
    weight: torch.Tensor
    cell: torch.Tensor


class TrajectorySampler:
    """Batches along trajectories: every age since reset, every noise level up to ``measurement_noise_max``.

    With several outputs there is a level for each. In half of the samples these are the same part of their largest
    ones; in the others they are drawn one by one, some of them zero.

    Noise is drawn from the covariance that the filter gives it at each age, and added to noise-free z. The network
    that fits such data in the mean square is the conditional mean of x.

    The errors that can be reached differ by orders of magnitude between ages and noise levels. Samples fall
    into ``cells`` of like age and levels, and the loss divides each by its cell's own recent error, so that all
    improve in proportion. Where parameters differ, motions of the system's own are in cells apart: their errors can be
    smaller, and in cells with the others they would count for little.

    Shapes: ``error`` (size, size), ``silent`` (size, k), ``noise_gain`` (modes,) or (ny, modes).
    """

    AGES_PER_BATCH = 32
    LEVELS = 6  # cells of noise level, the one without noise aside
    AGE_CELLS = 8
    PROCESS_CELLS = 3  # no process noise, weak and strong

    def __init__(
        self,
        data: Pairs,
        linear: LinearFilter,
        *,
        measurement_noise_max: float | tuple[float, ...],
        batch: int,
        device: torch.device,
        measurement_noise: float | tuple[float, ...] = 0.5,
        noise_free_share: float = 0.2,
        high_noise_emphasis: float = 2.0,
        process_noise_max: float = 0.0,
        error: np.ndarray | None = None,
        parameters: int = 0,
        scaling: Scaling = "relative",
        silent: np.ndarray | None = None,
    ) -> None:
        m, n, size = data.z.shape
        ny = linear.B.shape[1]
        largest = np.broadcast_to(np.asarray(measurement_noise_max, dtype=float), ny)
        usual = np.where(measurement_noise, measurement_noise, largest / 2)
        self.measurement_noise_max, self.measurement_noise_unit = largest, MEASUREMENT_NOISE_UNIT * usual
        rows = np.random.default_rng(0).permutation(m * n)[:SAMPLES]
        each = stationary_covariance(linear)
        together = np.einsum("j,jab->ab", (largest / largest.max()) ** 2, each)
        self.coordinates = coordinates(data.z.reshape(m * n, size)[rows], together, silent)
        gain, whiten = self.coordinates.noise_gain, self.coordinates.whiten
        self.noise_gain = gain
        if ny > 1:
            self.noise_gain = np.sqrt(np.maximum(np.einsum("ma,jab,mb->jm", whiten, each, whiten), 0.0))
        self.parameters = parameters
        self.scale = StateScale.of(data.x, scaling, nx=data.x.shape[-1] - parameters)
        self.process_noise_max = process_noise_max
        self.age_max = float(min(data.ages[-1] * linear.dt, settling_time(linear)))
        self.age_unit = AGE_UNIT * linear.dt
        self._noise_free_share, self._high_noise_emphasis = noise_free_share, high_noise_emphasis
        self._per_age = batch // self.AGES_PER_BATCH
        self._modes = torch.empty((m, n, len(gain)), device=device)
        for i in range(m):
            self._modes[i] = tensor(self.coordinates(data.z[i]), device)
        self._x = tensor(self.scale(data.x), device)
        self._weight = tensor(self.scale.weight(data.x), device)
        self._gain, self._each_gain = tensor(gain, device), tensor(np.atleast_2d(self.noise_gain)[:, None], device)
        self._level_max, self._level_unit = (
            tensor(values[:, None], device) for values in (self.measurement_noise_max, self.measurement_noise_unit)
        )
        # Noise in units of the stationary one, so that its covariances are well conditioned.
        unit = whiten / np.where(gain > 0, gain, 1.0)[:, None]
        late = int(np.ceil(2 * settling_time(linear) / linear.dt))
        saturated = np.minimum(data.ages, late)
        self._noise_root = tensor(root(unit @ noise_covariance(linear, saturated) @ unit.T), device)
        self._error_root = None if error is None else tensor(root(whiten @ error @ whiten.T), device)
        self._age = tensor(data.ages * linear.dt, device)
        self._oldest = data.ages[-1]
        self._age_cell = self.age_cell(data.ages, device)
        self._process_cell = torch.zeros(n, dtype=torch.long, device=device)
        if process_noise_max:
            self._process, self._process_cell = self.process_conditions(data.process_noise, device)
        self.kinds_of_plant = 1 if data.nominal is None else 2
        self._nominal_cell = self.nominal_cell(data, device)
        processes = self.PROCESS_CELLS if process_noise_max else 1
        self.cells = self.cell(self.AGE_CELLS - 1, self.LEVELS, processes - 1, self.kinds_of_plant - 1) + 1

    def __call__(self, generator: torch.Generator) -> Batch:
        """One batch."""
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
        modes = modes / (1.0 + ((level[..., None] * self._each_gain) ** 2).sum(1))
        conditions = [torch.log1p(level / self._level_unit).mT]
        if self.process_noise_max:
            conditions.append(self._process[rows][..., None])
        age = torch.log1p(self._age[ages].clamp(max=self.age_max) / self.age_unit)
        conditions.append(age[..., None].expand(*shape, 1))
        inputs = torch.cat([modes, *conditions], -1)
        level_cell = 1 + (position.mean(1) * self.LEVELS).long().clamp(0, self.LEVELS - 1)
        level_cell = torch.where((level > 0).any(1), level_cell, 0)
        cell = self.cell(self._age_cell[ages], level_cell, self._process_cell[rows], self._nominal_cell[rows])
        batch = self.AGES_PER_BATCH * self._per_age
        return Batch(
            inputs.reshape(batch, -1),
            self._x[ages, rows].reshape(batch, -1),
            self._weight[ages, rows].reshape(batch),
            cell.reshape(batch),
        )

    def _draw_levels(self, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Levels of measurement noise, (ages, ny, rows), and how far along their two decades they are, 0 to 1."""
        shape = (self.AGES_PER_BATCH, len(self._level_max), self._per_age)
        position = (torch.rand(shape, generator=generator, device=generator.device) - self._noise_free_share) / (
            1 - self._noise_free_share
        )
        if shape[1] > 1:
            alike = torch.rand(position[:, :1].shape, generator=generator, device=generator.device) < ALIKE
            position = torch.where(alike, position[:, :1], position)
        loud = position > 0
        position = position.clamp(min=0.0) ** (1 / self._high_noise_emphasis)
        level = self._level_max * 100 ** (position - 1)  # over two decades
        return position, torch.where(loud, level, torch.zeros_like(level))

    def process_conditions(self, process_noise: np.ndarray, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """Process noise features of levels (n,), and their parts in the number of the cell."""
        part = process_noise / self.process_noise_max
        cell = (part > 0).astype(int) + (part > 0.5)
        return tensor(np.log1p(part / PROCESS_NOISE_UNIT), device), torch.as_tensor(cell, device=device)

    def cell(self, age: Any, level: Any, process: Any, nominal: Any) -> Any:
        """Number of the cell where those of age, measurement noise, process noise and parameters meet."""
        number = (age * (1 + self.LEVELS) + level) * (self.PROCESS_CELLS if self.process_noise_max else 1) + process
        return number * self.kinds_of_plant + nominal

    def nominal_cell(self, data: Pairs, device: torch.device) -> torch.Tensor:
        """1 for trajectories of the system's own parameters where these differ, (n,); else 0."""
        nominal = np.zeros(data.x.shape[1]) if data.nominal is None else data.nominal
        return torch.as_tensor(nominal.astype(int), device=device)

    def age_cell(self, ages: np.ndarray, device: torch.device) -> torch.Tensor:
        """Cells of ages in samples."""
        position = np.log1p(ages) / np.log1p(self._oldest)
        cell = np.minimum((position * self.AGE_CELLS).astype(int), self.AGE_CELLS - 1)
        return torch.as_tensor(cell).to(device)

    def inverse_map(self, network: Network, linear: LinearFilter) -> InverseMap:
        """The map that a network trained on these batches makes."""
        return InverseMap(
            mlp=network.export(),
            features=(
                "z_y",
                *(["z_u"] if linear.nu else []),
                "measurement_noise",
                *(["process_noise"] if self.process_noise_max else []),
                "age",
            ),
            z_offset=self.coordinates.offset,
            whiten=self.coordinates.whiten,
            noise_gain=self.noise_gain,
            x_offset=self.scale.offset,
            x_scale=self.scale.scale,
            measurement_noise_unit=_float_or_tuple(self.measurement_noise_unit),
            measurement_noise_max=_float_or_tuple(self.measurement_noise_max),
            process_noise_unit=PROCESS_NOISE_UNIT * self.process_noise_max or 1.0,
            process_noise_max=self.process_noise_max or math.inf,
            age_unit=self.age_unit,
            age_max=self.age_max,
        )


def _float_or_tuple(values: np.ndarray) -> float | tuple[float, ...]:
    """A number for one output, a tuple for several, as inverse maps hold them."""
    return tuple(values.tolist()) if len(values) > 1 else float(values[0])


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


class ForwardMapSampler:
    """The paper's second data set S_2: drawn x', z' = T(x') by the map (sec. 5.2), without transients.

    The filter's z differs from T(x) by the error of T, which an inverse fitted to T(x') alone would magnify by its
    Lipschitz constant (paper, lemma R-eta-bound). z' is therefore blurred by Gaussian noise with the covariance of that
    error, measured on the forward map's own data, and each coordinate is shrunk to its linear conditional mean.

    Shapes: ``error`` (n, nz), ``points`` (n, nx).
    """

    cells, kinds_of_plant, parameters = 1, 1, 0

    def __init__(
        self,
        forward: TensorMap,
        error: np.ndarray,
        *,
        points: np.ndarray,
        batch: int,
        device: torch.device,
        scaling: Scaling = "relative",
    ) -> None:
        self.scale = StateScale.of(points, scaling)
        self._x, self._weight = tensor(self.scale(points), device), tensor(self.scale.weight(points), device)
        with torch.no_grad():
            parts = [forward(part).cpu().numpy() for part in torch.split(tensor(points, device), SAMPLES)]
        z = np.concatenate(parts).astype(float)
        some = np.random.default_rng(0).permutation(len(z))[:SAMPLES]
        self.coordinates = coordinates(z[some], error.T @ error / len(error))
        self._modes = tensor(self.coordinates(z), device)
        self._blur, self._batch = tensor(self.coordinates.noise_gain, device), batch

    def __call__(self, generator: torch.Generator) -> Batch:
        """One batch."""
        device = self._x.device
        rows = torch.randint(len(self._x), (self._batch,), generator=generator, device=device)
        modes = self._modes[rows]
        modes = modes + self._blur * torch.randn(modes.shape, generator=generator, device=device)
        cell = torch.zeros(len(rows), dtype=torch.long, device=device)
        return Batch(modes / (1.0 + self._blur**2), self._x[rows], self._weight[rows], cell)

    def inverse_map(self, network: Network, linear: LinearFilter) -> InverseMap:
        """The map that a network trained on these batches makes: the paper's, of z alone."""
        found = self.coordinates
        return InverseMap(
            mlp=network.export(),
            features=("z_y",),
            z_offset=found.offset,
            whiten=found.whiten / (1.0 + found.noise_gain**2)[:, None],
            noise_gain=np.zeros(len(found.noise_gain)),
            x_offset=self.scale.offset,
            x_scale=self.scale.scale,
        )


Sampler = TrajectorySampler | ClosedLoopSampler | ForwardMapSampler


class InverseProblem(nn.Module):
    """The inverse network with the running mean square error of each cell."""

    capturable = True

    def __init__(self, network: Network, sampler: Sampler, device: torch.device) -> None:
        super().__init__()
        self.network = network
        self.sampler = sampler
        cells = sampler.cells * (2 if sampler.parameters else 1)
        self.register_buffer("error", torch.ones(cells, device=device))
        self.register_buffer("visited", torch.zeros(cells, dtype=torch.bool, device=device))
        self.error: torch.Tensor
        self.visited: torch.Tensor
        self._risk = compiled(self.risk, device)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean square error of a batch, each cell relative to its own running error."""
        loss, error = self._risk(*self.sampler(generator))
        return {"loss": loss, "error": error}

    def risk(
        self, inputs: torch.Tensor, x: torch.Tensor, weight: torch.Tensor, cell: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The loss of a batch, and the geometric mean of the cells' running errors."""
        apart, nx = (self.network(inputs) - x) ** 2, x.shape[1] - self.sampler.parameters
        square = weight * apart[:, :nx].mean(-1)
        if self.sampler.parameters:  # cells of their own, for they are as hard where states are easy
            square = torch.cat([square, apart[:, nx:].mean(-1)])
            # Not apart for the system's own: a map would give these for every plant that is near.
            cell = torch.cat([cell, self.sampler.cells + cell // self.sampler.kinds_of_plant])
        detached = square.detach()
        count = torch.zeros_like(self.error).index_add_(0, cell, torch.ones_like(detached))
        mean = torch.zeros_like(self.error).index_add_(0, cell, detached) / count.clamp(min=1.0)
        keep = torch.where(count > 0, 0.99, 1.0)
        self.error.mul_(keep).add_((1 - keep) * mean)
        self.visited.logical_or_(count > 0)
        # Cells without data do not count; sums keep the shapes, which a CUDA graph asks for.
        error = (torch.where(self.visited, self.error.log(), 0.0).sum() / self.visited.sum()).exp().sqrt()
        return (square / self.error[cell]).mean(), error
