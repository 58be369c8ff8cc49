"""T_inv and unknown parameters from outputs alone: what a network minimises that sees no state.

Where the state cannot be recorded, the equations take its place: an estimate must explain the output that is measured
with it, and it must be where the equations carry an earlier estimate. The second demand reaches parameters as well.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import Components, System
from observers import LinearFilter
from training.filter_noise import stationary_covariance
from training.maps.coordinates import coordinates
from training.maps.networks import Network
from training.records import Record
from training.trajectories.parameters import with_values

HORIZON = 10  # samples between two estimates that the equations must lead from one to the other
DYNAMICS = 10.0  # weight of that, in half-widths of X, against the output's residual, in standard deviations
RATE_STEP = 0.3  # rate times the length of a Runge-Kutta step
PACE = 3.0  # of a parameter's logarithm, for each unit of what the optimiser moves
INSIDE = 1e-4  # part of the bounds' width that states keep from their ends
DIFFERENCES = 4  # of y, in which hardly anything is left of its motion, and all of its noise
FITTED = 100_000  # samples from which the filter's coordinates are found


@dataclass(frozen=True)
class Filtered:
    """``z`` (m, size), ``y`` (m, ny), ``u`` (m, nu) of records, from where a filter has forgotten its start."""

    z: list[np.ndarray]
    y: list[np.ndarray]
    u: list[np.ndarray]
    noise: np.ndarray


def filtered(records: Sequence[Record], linear: LinearFilter, first: int) -> Filtered:
    """Run a filter along records."""
    z = [run_filter(record, linear, np.arange(first, len(record.t))) for record in records]
    u = [np.zeros((len(record.t), linear.nu)) if record.u is None else record.u for record in records]
    return Filtered(z, [record.y[first:] for record in records], [inputs[first:] for inputs in u], noise_level(records))


def run_filter(record: Record, linear: LinearFilter, at: np.ndarray) -> np.ndarray:
    """A filter's states (m, size) at some samples of a record, sorted."""
    u = np.zeros((len(record.t), linear.nu)) if record.u is None else record.u
    return np.asarray(linear.run(record.y[:, None], u[:-1, None, : linear.nu], at)[:, 0])


def noise_level(records: Sequence[Record]) -> np.ndarray:
    """Standard deviation (ny,) of white noise on outputs, from differences of neighbouring samples."""
    order = DIFFERENCES
    gain = math.comb(2 * order, order)  # sum of the squares of the difference's coefficients
    parts = [np.diff(record.y, n=order, axis=0) ** 2 / gain for record in records if len(record.y) > order]
    blocks = [part.mean(0) for whole in parts for part in np.array_split(whole, max(1, len(whole) // 100))]
    return np.sqrt(np.median(blocks, axis=0))  # the median, as fast parts of a motion pass for noise


class ConsistencyProblem(nn.Module):
    """A network from z to x and the parameters' logarithms, with what both have to fulfil."""

    def __init__(
        self,
        system: System,
        unknown: Mapping[str, tuple[float, float]],
        data: Filtered,
        *,
        linear: LinearFilter,
        width: int,
        depth: int,
        batch: int,
    ) -> None:
        super().__init__()
        z = np.concatenate(data.z)
        rows = np.random.default_rng(0).permutation(len(z))[:FITTED]
        noise = np.einsum("j,jab->ab", data.noise**2, stationary_covariance(linear))
        self.coordinates = coordinates(z[rows], noise)
        self._shrink = 1.0 / (1.0 + self.coordinates.noise_gain**2)
        self.system, self._names, self._batch = system, tuple(unknown), batch
        self._modes = torch.as_tensor(self.modes(z), dtype=torch.float32)
        self._y = torch.as_tensor(np.concatenate(data.y), dtype=torch.float32)
        self._u = torch.as_tensor(np.concatenate(data.u), dtype=torch.float32)
        ends = np.cumsum([len(part) for part in data.z])
        begins = ends - [len(part) for part in data.z]
        pairs = [np.arange(begin, end - HORIZON) for begin, end in zip(begins, ends, strict=True)]
        self._pairs = torch.as_tensor(np.concatenate(pairs))
        low, high = system.box()
        self._centre, self._half = (torch.tensor(v, dtype=torch.float32) for v in ((low + high) / 2, (high - low) / 2))
        bounds = torch.tensor(system.bounds, dtype=torch.float32)
        room = INSIDE * (bounds[:, 1] - bounds[:, 0])  # as a root has no derivative at the end of its domain
        self._low, self._high = bounds[:, 0] + room, bounds[:, 1] - room
        self._spread = self._y.var(0).clamp(min=1e-30)
        self._dt = linear.dt
        self._substeps = 1 if system.discrete else max(1, math.ceil(system.typical_rate * linear.dt / RATE_STEP))
        self.network = Network(self._modes.shape[1], system.nx, width=width, depth=depth, activation="tanh")
        self.moved = nn.Parameter(torch.zeros(len(self._names)))
        start = [system.parameters[name] for name in self._names]
        limits = torch.tensor(list(unknown.values()), dtype=torch.float32).reshape(-1, 2)
        self._start, self._lowest, self._highest = torch.tensor(start), limits[:, 0], limits[:, 1]

    def modes(self, z: np.ndarray) -> np.ndarray:
        """What the network sees of filter states (..., size)."""
        return self.coordinates(z) * self._shrink

    def values(self) -> torch.Tensor:
        """The parameters (p,): multiples of what they began with, or, from zero, parts of the limits' width."""
        moved = PACE * self.moved
        width = self._highest - self._lowest
        values = torch.where(self._start == 0, 0.1 * width * moved, self._start * torch.exp(moved))
        return values.clamp(self._lowest, self._highest)

    def parameters_found(self) -> dict[str, float]:
        """The same by name."""
        return dict(zip(self._names, self.values().tolist(), strict=True))

    @torch.no_grad()
    def estimate(self, z: np.ndarray) -> np.ndarray:
        """States (n, nx) that the network makes of filter states (n, size)."""
        modes = torch.as_tensor(self.modes(z), dtype=torch.float32)
        return (self._centre + self._half * self.network(modes)).clamp(self._low, self._high).double().numpy()

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """How far estimates are from explaining outputs, and from following the equations."""
        rows = self._pairs[torch.randint(len(self._pairs), (self._batch,), generator=generator)]
        modes = torch.cat([self._modes[rows], self._modes[rows + HORIZON]])
        before, after = (self._centre + self._half * self.network(modes)).split(self._batch)
        model = with_values(self.system, dict(zip(self._names, self.values().unbind(), strict=True)))
        output = ((_stacked(components(model.h, before.unbind(-1)), before) - self._y[rows]) ** 2 / self._spread).mean()
        x = before.clamp(self._low, self._high)
        for k in range(HORIZON):
            x = self._step(model, x, self._u[rows + k]).clamp(self._low, self._high)
        dynamics = (((x - after) / self._half) ** 2).mean()
        return {"loss": output + DYNAMICS * dynamics, "output": output.detach(), "dynamics": dynamics.detach()}

    def _step(self, model: System, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """One sampling interval, by steps of the classical Runge-Kutta method."""
        nu, inputs = model.nu, u.unbind(-1)
        if model.discrete:
            return _stacked(model.step(x.unbind(-1), inputs if len(inputs) == nu else (0.0,) * nu), x)

        def slope(x: torch.Tensor) -> torch.Tensor:
            at = x.clamp(self._low, self._high).unbind(-1)  # beyond the bounds equations may know no numbers
            f: Components = model.f(at)
            if len(inputs) and nu:
                rows = input_matrix(model, at)
                f = [
                    fi + sum(g * ui for g, ui in zip(row, inputs, strict=True)) for fi, row in zip(f, rows, strict=True)
                ]
            return _stacked(f, x)

        h = self._dt / self._substeps
        for _ in range(self._substeps):
            k1 = slope(x)
            k2 = slope(x + h / 2 * k1)
            k3 = slope(x + h / 2 * k2)
            k4 = slope(x + h * k3)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x


def _stacked(values: Components, like: torch.Tensor) -> torch.Tensor:
    """Components as the last axis; numbers among them are repeated."""
    n = len(like)
    return torch.stack([torch.as_tensor(value, dtype=like.dtype).expand(n) for value in values], -1)
