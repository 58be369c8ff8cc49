"""Neural networks on sequences of outputs. Each has a cell of its own; all share the code of training and observer.

From its state and the features of new samples, a cell computes its next state, and a hidden vector for each sample.
"""

import math
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import nn

from examples.research.methods.base import Arrays, Configuration, Method, Task
from kkl_gym.system import System
from observers.estimator import Estimate, Estimator
from training.evaluation.levels import Level
from training.maps.networks import Network, tensor

ROWS, CHUNK = 64, 100  # rows of a batch, and samples in a chunk of truncated back-propagation
WIDTH = 64  # width of features and hidden vectors
LEARNING_RATE = 3e-3
READOUT = 128  # neurons of the layer between the hidden vector and the estimate
FAINT_NOISE = 0.01  # noise below this share of the default enters the network linearly, noise above it logarithmically
ROUNDING = 1e-3  # the loss is quadratic in errors below this length, in standard deviations of the states


class Cell(nn.Module):
    """A causal map of sequences. Shapes: features (samples, n, width), state (n, ...)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    @abstractmethod
    def start(self, n: int) -> torch.Tensor:
        """Return the state before the first sample."""

    @abstractmethod
    def forward(self, features: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return hidden vectors (samples, n, width), and the state after the last sample."""


class GRUCell(Cell):
    """torch's GRU."""

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self.gru = nn.GRU(width, width)

    def start(self, n: int) -> torch.Tensor:
        """Return zeros."""
        return torch.zeros(n, self.width)

    def forward(self, features: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Apply one layer."""
        hidden, last = self.gru(features, state[None])
        return hidden, last[0]


class LRUCell(Cell):
    """Blocks, each of a diagonal complex linear recurrence, a gated layer and a residual connection."""

    blocks: ClassVar[int] = 2
    decay: ClassVar[tuple[float, float]] = (0.003, 0.3)  # range of the initial decay rates, per sample
    turn: ClassVar[float] = 0.3  # rad per sample, the largest initial angle

    def __init__(self, width: int) -> None:
        super().__init__(width)
        rates = torch.linspace(*map(math.log, self.decay), width)  # type: ignore[call-overload]
        self.log_decay = nn.Parameter(rates.repeat(self.blocks, 1))
        self.angle = nn.Parameter(self.turn * torch.rand(self.blocks, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(self.blocks))
        self.inlets = nn.ModuleList(nn.Linear(width, 2 * width) for _ in range(self.blocks))
        self.gates = nn.ModuleList(nn.Linear(3 * width, 2 * width) for _ in range(self.blocks))

    def start(self, n: int) -> torch.Tensor:
        """Return zeros, with real and imaginary parts side by side."""
        return torch.zeros(n, self.blocks, self.width, 2)

    def forward(self, features: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Apply all blocks."""
        after = []
        for i, (norm, inlet, gate) in enumerate(zip(self.norms, self.inlets, self.gates, strict=True)):
            decay = self.log_decay[i].exp()
            factor = torch.polar((-decay).exp(), self.angle[i])
            gain = (1.0 - (-2.0 * decay).exp()).sqrt()  # gives the state the size of its input
            seen = norm(features)
            driving = gain * torch.complex(*inlet(seen).chunk(2, -1))
            x, states = torch.view_as_complex(state[:, i].contiguous()), []
            for sample in driving:
                x = factor * x + sample
                states.append(x)
            value, opening = gate(torch.cat([*_parts(torch.stack(states)), seen], -1)).chunk(2, -1)
            features = features + value * opening.sigmoid()
            after.append(torch.view_as_real(x))
        return features, torch.stack(after, 1)


def _parts(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return z.real, z.imag


class TransformerCell(Cell):
    """Blocks, each of causal attention and a hidden layer; the state holds keys and values of the last samples."""

    blocks: ClassVar[int] = 2
    heads: ClassVar[int] = 4
    window: ClassVar[int] = 100  # samples

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self.bias = nn.Parameter(torch.zeros(self.blocks, self.heads, self.window + 1))  # bias by the age of a sample
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2 * self.blocks))
        self.inlets = nn.ModuleList(nn.Linear(width, 3 * width) for _ in range(self.blocks))
        self.outlets = nn.ModuleList(nn.Linear(width, width) for _ in range(self.blocks))
        self.layers = nn.ModuleList(
            Network(width, width, width=2 * width, depth=1, activation="silu") for _ in range(self.blocks)
        )

    def start(self, n: int) -> torch.Tensor:
        """Return keys and values of zero."""
        return torch.zeros(n, self.blocks, self.window, 2 * self.width)

    def forward(self, features: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Apply all blocks; a sample attends only to itself and to a window of samples before it."""
        samples, after = len(features), []
        age = torch.arange(samples)[:, None] + self.window - torch.arange(self.window + samples)
        hidden_by_age = (age < 0) | (age > self.window)
        features = features.transpose(0, 1)
        for i in range(self.blocks):
            query, *new = self.inlets[i](self.norms[2 * i](features)).chunk(3, -1)
            kept = torch.cat([state[:, i], torch.cat(new, -1)], 1)
            bias = self.bias[i][:, age.clamp(0, self.window)].masked_fill(hidden_by_age, -math.inf)
            key, value = (self._by_head(part) for part in kept.chunk(2, -1))
            seen = nn.functional.scaled_dot_product_attention(self._by_head(query), key, value, attn_mask=bias)
            features = features + self.outlets[i](seen.transpose(1, 2).flatten(2))
            features = features + self.layers[i](self.norms[2 * i + 1](features))
            after.append(kept[:, samples:])
        return features.transpose(0, 1), torch.stack(after, 1)

    def _by_head(self, part: torch.Tensor) -> torch.Tensor:
        return part.reshape(*part.shape[:2], self.heads, -1).transpose(1, 2)


class Model(nn.Module):
    """A network around a cell: maps samples of y and y's noise level to scaled estimates. Buffers hold the scales."""

    def __init__(self, kind: type[Cell], width: int, ny: int, nx: int) -> None:
        super().__init__()
        self.inlet, self.cell = nn.Linear(2 * ny, width), kind(width)
        self.readout = Network(width, nx, width=READOUT, depth=1, activation="tanh")
        for name, size in (("y", ny), ("x", nx)):
            self.register_buffer(f"{name}_offset", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        self.y_offset: torch.Tensor
        self.y_scale: torch.Tensor
        self.x_offset: torch.Tensor
        self.x_scale: torch.Tensor

    def forward(self, y: torch.Tensor, noise: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return scaled estimates (samples, n, nx) and the state after y (samples, n, ny); NaN counts as y's mean."""
        scaled = torch.nan_to_num((y - self.y_offset) / self.y_scale)
        hidden, state = self.cell(self.inlet(torch.cat([scaled, noise.expand_as(scaled)], -1)), state)
        return self.readout(hidden), state


class SequenceMethod(Method[Arrays]):
    """A method that trains a cell by truncated back-propagation along trajectories.

    The rows of a batch are at random times of their trajectories: transients and settled motion. Half of the
    trajectories have no noise, the others a random level up to the system's own; the level is an input of the network.
    The loss is the mean length of the scaled error, because transients would dominate its square.
    """

    kind: ClassVar[type[Cell]]

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """Train the network; returns its weights and scales."""
        torch.manual_seed(task.seed)
        problem = _Problem(self.kind, task)
        task.fit(self.name, problem, problem.loss, LEARNING_RATE)
        return {key: value.detach().numpy() for key, value in problem.model.state_dict().items()}

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """Return the network as an observer that takes one sample at a time."""
        own = np.broadcast_to(np.asarray(system.measurement_noise, dtype=float), (system.ny,))
        level = np.minimum(np.divide(noise, own, out=np.zeros(system.ny), where=own > 0), 1.0)
        model = Model(self.kind, WIDTH, system.ny, system.nx)
        model.load_state_dict({key: torch.as_tensor(value) for key, value in trained.items()})
        return SequenceObserver(model, level_feature(torch.as_tensor(level, dtype=torch.float32)))


class GRU(SequenceMethod):
    """A gated recurrent unit."""

    name: ClassVar[str] = "gru"
    label: ClassVar[str] = "GRU"
    kind: ClassVar[type[Cell]] = GRUCell


class LRU(SequenceMethod):
    """Linear recurrent unit: Orvieto et al., "Resurrecting recurrent neural networks for long sequences", ICML 2023."""

    name: ClassVar[str] = "lru"
    label: ClassVar[str] = "LRU"
    kind: ClassVar[type[Cell]] = LRUCell


class Transformer(SequenceMethod):
    """Z. Dai et al., "Transformer-XL: attentive language models beyond a fixed-length context", ACL 2019."""

    name: ClassVar[str] = "transformer"
    label: ClassVar[str] = "Transformer"
    kind: ClassVar[type[Cell]] = TransformerCell


class _Problem(nn.Module):
    """The model, and the positions of rows along the trajectories, in buffers that checkpoints contain.

    A row follows a trajectory from its start up to a random age in samples, and then begins another one.
    """

    def __init__(self, kind: type[Cell], task: Task) -> None:
        super().__init__()
        data, cpu = task.data, torch.device("cpu")
        self.model = Model(kind, WIDTH, data.y.shape[-1], data.x.shape[-1])
        for name, values in (("y", data.y), ("x", data.x)):
            spread = values.std((0, 1), dtype=float)
            getattr(self.model, f"{name}_offset").copy_(torch.as_tensor(values.mean((0, 1), dtype=float)))
            getattr(self.model, f"{name}_scale").copy_(torch.as_tensor(np.where(spread > 0, spread, 1.0)))
        self._y = tensor(data.y, cpu)
        self._x = (tensor(data.x, cpu) - self.model.x_offset) / self.model.x_scale
        self._noise = tensor(np.broadcast_to(task.system.measurement_noise, data.y.shape[-1:]), cpu)
        self._number = torch.full((len(data.y),), -1)  # index of each sample among those with known x, or -1
        self._number[torch.as_tensor(data.ages)] = torch.arange(len(data.ages))
        self._steps = torch.arange(min(CHUNK, len(data.y)))[:, None]
        self.register_buffer("places", torch.zeros(3, ROWS, dtype=torch.long))  # trajectory, age, and age at the end
        self.register_buffer("level", torch.zeros(ROWS, 1))
        self.register_buffer("state", self.model.cell.start(ROWS))
        self.places: torch.Tensor
        self.level: torch.Tensor
        self.state: torch.Tensor

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Return the mean error at those samples of the next chunk whose x is known."""
        (length, trajectories, _), (_, age, end) = self._y.shape, self.places
        fresh = (age >= end) | (age + len(self._steps) > length)
        zero = torch.zeros(ROWS, dtype=torch.long)
        drawn = torch.randint(trajectories, (ROWS,), generator=generator)
        ends = torch.randint(1, length + 1, (ROWS,), generator=generator)
        level = (torch.rand((ROWS, 1), generator=generator) * 2 - 1).clamp(min=0.0)
        self.places.copy_(torch.where(fresh, torch.stack([drawn, zero, ends]), self.places))
        self.level.copy_(torch.where(fresh[:, None], level, self.level))
        trajectory, age, _ = self.places.clone()
        ages = age + self._steps
        y = self._y[ages, trajectory]
        y = y + self.level * self._noise * torch.randn(y.shape, generator=generator)
        state = torch.where(fresh.view(-1, *[1] * (self.state.dim() - 1)), self.model.cell.start(ROWS), self.state)
        x_hat, state = self.model(y, level_feature(self.level), state)
        self.state.copy_(state.detach())
        self.places[1] += len(self._steps)
        number = self._number[ages]
        recorded = number >= 0
        x = self._x[number[recorded], trajectory.expand_as(number)[recorded]]
        lengths = ((x_hat[recorded] - x).square().sum(-1) + ROUNDING**2).sqrt()
        return {"loss": lengths.sum() / max(len(lengths), 1)}


def level_feature(level: torch.Tensor) -> torch.Tensor:
    """Return the networks' input for noise levels, which are in multiples of the system's own."""
    return torch.asinh(level / FAINT_NOISE)


class Memory(NamedTuple):
    """The cell's state (n, ...), and the estimates (n, nx)."""

    state: np.ndarray
    x_hat: np.ndarray


class SequenceObserver:
    """A trained model as an observer."""

    def __init__(self, model: Model, noise: torch.Tensor) -> None:
        self._model, self._noise = model, noise

    def start(self, n: int) -> Memory:
        """Return the memory of n rows before their first sample."""
        return Memory(self._model.cell.start(n).numpy(), np.zeros((n, len(self._model.x_scale))))

    @torch.no_grad()
    def advance(self, state: Memory, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> Memory:
        """Process one sample of each row."""
        sample = torch.as_tensor(y, dtype=torch.float32)[None]
        x_hat, after = self._model(sample, self._noise, torch.as_tensor(state.state))
        x = self._model.x_offset + self._model.x_scale * x_hat[0]
        return Memory(after.numpy(), x.double().numpy())

    def estimate(self, state: Memory) -> Estimate:
        """Return the model's estimates."""
        return Estimate(state.x_hat)
