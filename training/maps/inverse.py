"""The inverse T_inv as a network: what its training minimises."""

import torch
from torch import nn

from training.maps.networks import Network, compiled
from training.maps.samplers import Sampler


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
