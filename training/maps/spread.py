"""The covariance of T_inv's error as a network: what its training minimises."""

import dataclasses

import numpy as np
import torch
from torch import nn

from observers import InverseMap, Spread
from training.maps.networks import Network, from_mlp
from training.maps.optimise import optimise_at_once
from training.maps.regions import LEVELS
from training.maps.samplers import TrajectorySampler
from training.progress import ProgressBars

WIDTH, DEPTH, LEARNING_RATE = 32, 1, 3e-3


class SpreadProblem(nn.Module):
    """The network of :class:`observers.Spread`, fitted by Gaussian likelihood to the errors of a map that stays."""

    def __init__(
        self, inverse: InverseMap, sampler: TrajectorySampler, nx: int, *, width: int, depth: int, device: torch.device
    ) -> None:
        super().__init__()
        self.network = Network(inverse.mlp.inputs, nx * (nx + 1) // 2, width=width, depth=depth, activation="tanh").to(
            device
        )
        self._sampler, self._nx = sampler, nx
        self._mean = from_mlp(inverse.part(slice(nx)).mlp, device=device)
        self._row, self._column = np.tril_indices(nx, -1)
        last = self.network.linear_layers()[-1]
        with torch.no_grad():  # begins with the errors' usual size, whatever the inputs
            _, error = self._errors(torch.Generator(device).manual_seed(0))
            nn.init.zeros_(last.weight)
            last.bias[:nx] = (error**2).mean(0).clamp(min=1e-12).log() / 2

    def _errors(self, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """What the networks are given, and scaled errors (batch, nx)."""
        inputs, x, _, _ = self._sampler(generator)
        with torch.no_grad():
            return inputs, x[:, : self._nx] - self._mean(inputs)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean negative logarithm of the errors' likelihood in a batch, but for a constant."""
        inputs, error = self._errors(generator)
        out, nx = self.network(inputs), self._nx
        log, lower = out[:, :nx], out[:, nx:]
        scaled, white = error * (-log).exp(), list[torch.Tensor]()
        for i in range(nx):  # solves L white = scaled
            mine = scaled[:, i]
            for k in np.flatnonzero(self._row == i).tolist():
                mine = mine - lower[:, k] * white[self._column[k]]
            white.append(mine)
        return {"loss": (log.sum(-1) + torch.stack(white, -1).square().sum(-1) / 2).mean()}


def with_spread(
    inverse: InverseMap,
    sampler: TrajectorySampler,
    nx: int,
    *,
    ages: np.ndarray,
    tables: int = 1,
    name: str = "error bars",
    steps: int,
    seed: int,
    progress: ProgressBars,
    device: torch.device,
) -> InverseMap:
    """Give a map a network of its errors. Shapes: ``ages`` (m,)."""
    problem = SpreadProblem(inverse, sampler, nx, width=WIDTH, depth=DEPTH, device=device)
    optimise_at_once(name, problem.network, problem.loss, progress, steps=steps, learning_rate=LEARNING_RATE, seed=seed)
    ones = np.ones((*(() if tables == 1 else (tables,)), len(LEVELS), len(ages)))
    return dataclasses.replace(inverse, spread=Spread(problem.network.export(), np.array(LEVELS), ages, ones))
