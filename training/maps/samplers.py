"""Batches on which the inverse is fitted."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from observers import InverseMap, LinearFilter
from training.filter_noise import noise_covariance, root, stationary_covariance
from training.maps.coordinates import coordinates, settling_time
from training.maps.networks import Network, tensor
from training.trajectories.closed_loop import ClosedLoop
from training.trajectories.record import Trajectories

MEASUREMENT_NOISE_UNIT = 0.02  # in the noise feature log(1 + sigma_v / unit)
AGE_UNIT = 0.05  # s, in the age feature log(1 + t / unit)
PROCESS_NOISE_UNIT = 0.1  # of the highest level, in the process noise feature log(1 + level / unit)


# inputs (batch, inputs), x scaled (batch, nx), weight (batch,), cell (batch,)
Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


class TrajectorySampler:
    """Batches along trajectories: every age since reset, every noise level up to ``measurement_noise_max``.

    Noise is drawn from the covariance that the filter gives it at each age, and added to noise-free z. The network
    that fits such data in the mean square is the conditional mean of x. A share ``noise_free_share`` of the samples has
    no noise; of the others a share p ** ``high_noise_emphasis`` lies below the level at p of the way, on a logarithmic
    scale, along the two decades up to ``measurement_noise_max``: high levels are harder to learn. If
    ``process_noise_max`` is not 0 the network is told the level of process noise as well, up to this one.

    The errors that can be reached differ by orders of magnitude between ages and noise levels. Samples fall
    into ``cells`` of like age and levels, and the loss divides each by its cell's own recent error, so that all
    improve in proportion.
    """

    AGES_PER_BATCH = 32
    LEVELS = 6  # cells of noise level, the one without noise aside
    AGE_CELLS = 8
    PROCESS_CELLS = 3  # no process noise, weak and strong

    def __init__(
        self,
        data: Trajectories,
        linear: LinearFilter,
        *,
        measurement_noise_max: float,
        batch: int,
        device: torch.device,
        noise_free_share: float = 0.2,
        high_noise_emphasis: float = 2.0,
        process_noise_max: float = 0.0,
    ) -> None:
        m, n, size = data.z.shape
        rows = np.random.default_rng(0).permutation(m * n)[:100_000]
        self.coordinates = coordinates(data.z.reshape(m * n, size)[rows], stationary_covariance(linear))
        gain = self.coordinates.noise_gain
        self.x_offset = data.x.mean((0, 1))
        self.x_scale = data.x.std((0, 1))
        self.measurement_noise_max, self.process_noise_max = measurement_noise_max, process_noise_max
        self._noise_free_share, self._high_noise_emphasis = noise_free_share, high_noise_emphasis
        self.age_max = float(min(data.ages[-1] * linear.dt, settling_time(linear)))
        self._per_age = batch // self.AGES_PER_BATCH
        self._modes = torch.empty((m, n, len(gain)), device=device)
        for i in range(m):
            self._modes[i] = tensor(self.coordinates(data.z[i]), device)
        self._x = tensor((data.x - self.x_offset) / self.x_scale, device)
        self._weight = self.weight(data.x, device)
        self._gain = tensor(gain, device)
        # Noise in units of the stationary one, so that its covariances are well conditioned.
        unit = self.coordinates.whiten / np.where(gain > 0, gain, 1.0)[:, None]
        late = int(np.ceil(2 * settling_time(linear) / linear.dt))
        saturated = np.minimum(data.ages, late)
        self._noise_root = tensor(root(unit @ noise_covariance(linear, saturated) @ unit.T), device)
        self._age = tensor(data.ages * linear.dt, device)
        self._oldest = data.ages[-1]
        self._age_cell = self.age_cell(data.ages, device)
        self._process_cell = torch.zeros(n, dtype=torch.long, device=device)
        if process_noise_max:
            self._process, self._process_cell = self.process_conditions(data.process_noise, device)
        self.cells = self.cell(self.AGE_CELLS - 1, self.LEVELS, self.PROCESS_CELLS - 1 if process_noise_max else 0) + 1

    def __call__(self, generator: torch.Generator) -> Batch:
        """One batch."""
        device = self._x.device
        m, n, _ = self._x.shape
        ages = torch.randint(m, (self.AGES_PER_BATCH, 1), generator=generator, device=device)
        shape = (self.AGES_PER_BATCH, self._per_age)
        rows = torch.randint(n, shape, generator=generator, device=device)
        position = (torch.rand(shape, generator=generator, device=device) - self._noise_free_share) / (
            1 - self._noise_free_share
        )
        loud = position > 0
        position = position.clamp(min=0.0) ** (1 / self._high_noise_emphasis)
        level = self.measurement_noise_max * 100 ** (position - 1)  # over two decades
        level = torch.where(loud, level, torch.zeros_like(level))[..., None]
        white = torch.randn((*shape, self._noise_root.shape[-1]), generator=generator, device=device)
        noise = white @ self._noise_root[ages[:, 0]].mT
        modes = self._modes[ages, rows] + level * self._gain * noise
        modes = modes / (1.0 + (level * self._gain) ** 2)
        conditions = [torch.log1p(level / MEASUREMENT_NOISE_UNIT)]
        if self.process_noise_max:
            conditions.append(self._process[rows][..., None])
        conditions.append(torch.log1p(self._age[ages].clamp(max=self.age_max) / AGE_UNIT)[..., None].expand_as(level))
        inputs = torch.cat([modes, *conditions], -1)
        level_cell = torch.where(loud, 1 + (position * self.LEVELS).long().clamp(0, self.LEVELS - 1), 0)
        cell = self.cell(self._age_cell[ages], level_cell, self._process_cell[rows])
        batch = self.AGES_PER_BATCH * self._per_age
        return (
            inputs.reshape(batch, -1),
            self._x[ages, rows].reshape(batch, -1),
            self._weight[ages, rows].reshape(batch),
            cell.reshape(batch),
        )

    def process_conditions(self, process_noise: np.ndarray, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """What the network is told of levels of process noise, (n,), and their parts in the number of the cell."""
        part = process_noise / self.process_noise_max
        cell = (part > 0).astype(int) + (part > 0.5)
        return tensor(np.log1p(part / PROCESS_NOISE_UNIT), device), torch.as_tensor(cell, device=device)

    def cell(self, age: Any, level: Any, process: Any) -> Any:
        """Number of the cell where those of age, measurement noise and process noise meet."""
        return (age * (1 + self.LEVELS) + level) * (self.PROCESS_CELLS if self.process_noise_max else 1) + process

    def weight(self, x: np.ndarray, device: torch.device) -> torch.Tensor:
        """Of states (..., nx) in the loss: errors count relative to the state's size."""
        nx = x.shape[-1]
        return tensor(nx / (((x / self.x_scale) ** 2).sum(-1) + 0.1 * nx), device)

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
            noise_gain=self.coordinates.noise_gain,
            x_offset=self.x_offset,
            x_scale=self.x_scale,
            measurement_noise_unit=MEASUREMENT_NOISE_UNIT,
            measurement_noise_max=self.measurement_noise_max,
            process_noise_unit=PROCESS_NOISE_UNIT * self.process_noise_max or 1.0,
            process_noise_max=self.process_noise_max or math.inf,
            age_unit=AGE_UNIT,
            age_max=self.age_max,
        )


class ClosedLoopSampler:
    """Batches half from open-loop trajectories, half from closed-loop ones, with the noise that these already hold."""

    def __init__(self, open_loop: TrajectorySampler, data: ClosedLoop, *, dt: float, device: torch.device) -> None:
        self.open_loop = open_loop
        coordinates, gain = open_loop.coordinates, open_loop.coordinates.noise_gain
        shrink = 1.0 + (data.measurement_noise[:, None] * gain) ** 2
        self._modes = tensor(coordinates(data.z) / shrink, device)
        self._x = tensor((data.x - open_loop.x_offset) / open_loop.x_scale, device)
        self._level = tensor(np.log1p(data.measurement_noise / MEASUREMENT_NOISE_UNIT), device)
        self._age = tensor(np.log1p(np.minimum(data.ages * dt, open_loop.age_max) / AGE_UNIT), device)
        self._weight = open_loop.weight(data.x, device)
        self._age_cell = open_loop.age_cell(data.ages, device)
        position = (
            np.log10(np.maximum(data.measurement_noise / open_loop.measurement_noise_max, 1e-9)) / 2 + 1
        )  # over two decades, as there
        level_cell = np.where(
            data.measurement_noise > 0, 1 + np.clip(position * open_loop.LEVELS, 0, open_loop.LEVELS - 1), 0
        )
        self._level_cell = torch.as_tensor(level_cell.astype(int), device=device)
        self._process_cell = torch.zeros_like(self._level_cell)
        if open_loop.process_noise_max:
            self._process, self._process_cell = open_loop.process_conditions(data.process_noise, device)
        self.cells = 2 * open_loop.cells

    def __call__(self, generator: torch.Generator) -> Batch:
        """One batch."""
        inputs, x, weight, cell = self.open_loop(generator)
        m, n, _ = self._x.shape
        half, device = len(x) // 2, self._x.device
        ages = torch.randint(m, (half,), generator=generator, device=device)
        rows = torch.randint(n, (half,), generator=generator, device=device)
        conditions = [self._level[rows], self._age[ages]]
        if self.open_loop.process_noise_max:
            conditions.insert(1, self._process[rows])
        closed = torch.cat([self._modes[ages, rows], torch.stack(conditions, -1)], -1)
        closed_cell = self.open_loop.cell(self._age_cell[ages], self._level_cell[rows], self._process_cell[rows])
        return (
            torch.cat([inputs[:half], closed]),
            torch.cat([x[:half], self._x[ages, rows]]),
            torch.cat([weight[:half], self._weight[ages, rows]]),
            torch.cat([cell[:half], self.open_loop.cells + closed_cell]),
        )

    def inverse_map(self, network: Network, linear: LinearFilter) -> InverseMap:
        """The map that a network trained on these batches makes."""
        return self.open_loop.inverse_map(network, linear)


class ForwardMapSampler:
    """The paper's second data set S_2: x' uniform in the training box (or given), z' = T(x') by the map (sec. 5.2).

    The filter's z differs from T(x) by the error of T, which an inverse fitted to T(x') alone would magnify by its
    Lipschitz constant (paper, lemma R-eta-bound). z' is therefore blurred by Gaussian noise with the covariance of that
    error, measured on the forward map's own data, and each coordinate is shrunk to its linear conditional mean.

    Parameters
    ----------
    forward : T on tensors, (n, nx) to (n, nz).
    error : samples of z - T(x), (n, nz).
    box : low and high corner of where x' is drawn.
    points : states (n, nx) of which x' is drawn instead.
    """

    cells = 1

    def __init__(
        self,
        forward: Callable[[torch.Tensor], torch.Tensor],
        error: np.ndarray,
        *,
        box: tuple[np.ndarray, np.ndarray],
        batch: int,
        device: torch.device,
        points: np.ndarray | None = None,
    ) -> None:
        low, high = box if points is None else (points.min(0), points.max(0))
        self._low, self._span = tensor(low, device), tensor(high - low, device)
        self._points = None if points is None else tensor(points, device)
        self._forward, self._batch = forward, batch
        x = self._draw(torch.Generator(device).manual_seed(0), 100_000)
        with torch.no_grad():
            z = forward(x).cpu().numpy().astype(float)
        self.coordinates = coordinates(z, error.T @ error / len(error))
        self.x_offset, self.x_scale = (low + high) / 2, (high - low) / 2
        self._offset, self._scale = tensor(self.x_offset, device), tensor(self.x_scale, device)
        self._z_offset = torch.as_tensor(self.coordinates.offset, device=device)
        self._whiten = torch.as_tensor(self.coordinates.whiten, device=device)
        self._blur = tensor(self.coordinates.noise_gain, device)

    def _draw(self, generator: torch.Generator, n: int) -> torch.Tensor:
        if self._points is not None:
            rows = torch.randint(len(self._points), (n,), generator=generator, device=generator.device)
            return self._points[rows]
        return self._low + self._span * torch.rand((n, len(self._low)), generator=generator, device=generator.device)

    @torch.no_grad()
    def __call__(self, generator: torch.Generator) -> Batch:
        """One batch."""
        x = self._draw(generator, self._batch)
        modes = ((self._forward(x).double() - self._z_offset) @ self._whiten.T).float()
        modes = modes + self._blur * torch.randn(modes.shape, generator=generator, device=x.device)
        modes = modes / (1.0 + self._blur**2)
        ones = torch.ones(len(x), device=x.device)
        return modes, (x - self._offset) / self._scale, ones, torch.zeros(len(x), dtype=torch.long, device=x.device)

    def inverse_map(self, network: Network, linear: LinearFilter) -> InverseMap:
        """The map that a network trained on these batches makes: the paper's, of z alone."""
        found = self.coordinates
        return InverseMap(
            mlp=network.export(),
            features=("z_y",),
            z_offset=found.offset,
            whiten=found.whiten / (1.0 + found.noise_gain**2)[:, None],
            noise_gain=np.zeros(len(found.noise_gain)),
            x_offset=self.x_offset,
            x_scale=self.x_scale,
        )


Sampler = TrajectorySampler | ClosedLoopSampler | ForwardMapSampler
