"""A recurrent network on the output history: what a machine-learning user would try first."""

from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from examples.research.methods.base import Arrays, Configuration, Method, Task
from kkl_gym.system import System
from observers.estimator import Estimate, Estimator
from training.evaluation.levels import Level
from training.maps.networks import tensor

BATCH = 128
LEARNING_RATE = 3e-3


class GRU(Method[Arrays]):
    """torch's GRU with a linear read-out, trained by truncated back-propagation along trajectories from their start.

    Half of the trajectories carry no noise, the others a level up to the system's own, which is no input.
    """

    name: ClassVar[str] = "gru"
    label: ClassVar[str] = "GRU"

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Two sizes, two lengths of back-propagation."""
        return ({"hidden": 64, "chunk": 100}, {"hidden": 64, "chunk": 250}, {"hidden": 128, "chunk": 100})

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """The network and its scaling."""
        torch.manual_seed(task.seed)
        problem = _Problem(task, **configuration)
        task.fit("gru", problem, problem.loss, LEARNING_RATE)
        arrays = {key: value.cpu().numpy() for key, value in problem.network.state_dict().items()}
        return {**arrays, **problem.scaling}

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """The network, one sample at a time."""
        return Recurrent(trained)


class _Network(nn.Module):
    def __init__(self, ny: int, nx: int, hidden: int) -> None:
        super().__init__()
        self.gru = nn.GRU(ny, hidden)
        self.readout = nn.Linear(hidden, nx)


class _Problem(nn.Module):
    """The network, and how far the current batch of trajectories has come: all of it is part of a checkpoint."""

    def __init__(self, task: Task, *, hidden: int, chunk: int) -> None:
        super().__init__()
        data, device = task.data, task.device
        ny, nx = data.y.shape[-1], data.x.shape[-1]
        self.network = _Network(ny, nx, hidden).to(device)
        self.scaling = {
            "y_offset": data.y.mean((0, 1), dtype=float),
            "y_scale": data.y.std((0, 1), dtype=float),
            "x_offset": data.x.mean((0, 1)),
            "x_scale": data.x.std((0, 1)),
        }
        scaling = self.scaling
        self._y = tensor((data.y - scaling["y_offset"]) / scaling["y_scale"], device)
        self._x = tensor((data.x - scaling["x_offset"]) / scaling["x_scale"], device)
        self._largest = tensor(np.asarray(task.system.measurement_noise) / scaling["y_scale"], device)
        self._ages, self._chunk = data.ages, chunk
        self.register_buffer("position", torch.tensor(len(data.y)))
        self.register_buffer("rows", torch.zeros(BATCH, dtype=torch.long, device=device))
        self.register_buffer("level", torch.zeros(BATCH, 1, device=device))
        self.register_buffer("hidden", torch.zeros(1, BATCH, hidden, device=device))
        self.position: torch.Tensor
        self.rows: torch.Tensor
        self.level: torch.Tensor
        self.hidden: torch.Tensor

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean square error at the recorded points of the next chunk."""
        device = self._y.device
        if int(self.position) >= len(self._y):
            self.position.zero_()
            self.rows.copy_(torch.randint(self._y.shape[1], (BATCH,), generator=generator, device=device))
            level = torch.rand((BATCH, 1), generator=generator, device=device) * 2 - 1
            self.level.copy_(level.clamp(min=0.0))
            self.hidden.zero_()
        first = int(self.position)
        y = self._y[first : first + self._chunk, self.rows]
        y = y + self.level * self._largest * torch.randn(y.shape, generator=generator, device=device)
        features, hidden = self.network.gru(y, self.hidden.clone())
        recorded = np.flatnonzero((self._ages >= first) & (self._ages < first + len(y)))
        self.position.add_(len(y))
        self.hidden.copy_(hidden.detach())
        if not len(recorded):  # nothing was recorded here: only the state is carried on
            return {"loss": 0.0 * features.sum()}
        estimate = self.network.readout(features[self._ages[recorded] - first])
        return {"loss": ((estimate - self._x[recorded][:, self.rows]) ** 2).mean()}


class Recurrent:
    """The trained network as an observer."""

    def __init__(self, arrays: Arrays) -> None:
        hidden, ny = arrays["gru.weight_hh_l0"].shape[1], arrays["gru.weight_ih_l0"].shape[1]
        self._network = _Network(ny, len(arrays["readout.bias"]), hidden)
        scaling = ("y_offset", "y_scale", "x_offset", "x_scale")
        weights = {key: torch.as_tensor(value) for key, value in arrays.items() if key not in scaling}
        self._network.load_state_dict(weights)
        self._y_offset, self._y_scale, self._x_offset, self._x_scale = (arrays[key] for key in scaling)

    def start(self, n: int) -> torch.Tensor:
        """A hidden state of zero."""
        return torch.zeros(1, n, self._network.gru.hidden_size)

    @torch.no_grad()
    def advance(
        self, state: torch.Tensor, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None
    ) -> torch.Tensor:
        """One sample."""
        scaled = torch.as_tensor((y - self._y_offset) / self._y_scale, dtype=torch.float32)
        hidden: torch.Tensor = self._network.gru(scaled[None], state)[1]
        return hidden

    @torch.no_grad()
    def estimate(self, state: torch.Tensor) -> Estimate:
        """The readout."""
        return Estimate(np.asarray(self._x_offset + self._x_scale * self._network.readout(state[0]).numpy()))
