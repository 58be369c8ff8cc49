"""The inverse T_inv as a network: what its training minimises."""

import torch
from torch import nn

from training.maps.networks import Network
from training.maps.samplers import Sampler


class InverseProblem(nn.Module):
    """The inverse network with the running mean square error of each cell."""

    def __init__(
        self, network: Network, sampler: Sampler, device: torch.device, *, lipschitz_penalty: float = 0.0
    ) -> None:
        super().__init__()
        self.network = network
        self.sampler = sampler
        self._lipschitz_penalty = lipschitz_penalty
        cells = sampler.cells * (2 if sampler.parameters else 1)
        self.register_buffer("error", torch.ones(cells, device=device))
        self.register_buffer("visited", torch.zeros(cells, dtype=torch.bool, device=device))
        self.error: torch.Tensor
        self.visited: torch.Tensor
        if lipschitz_penalty:
            self._whiten = torch.as_tensor(sampler.coordinates.whiten, dtype=torch.float32, device=device)
            for i, weight in enumerate(self._slopes()):
                start = torch.ones(weight.shape[1], device=device) / weight.shape[1] ** 0.5
                self.register_buffer(f"direction{i}", start)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean square error of a batch, each cell relative to its own running error."""
        inputs, x, weight, cell = self.sampler(generator)
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
        self.visited |= count > 0  # there may be cells without data
        error = self.error[self.visited].log().mean().exp().sqrt()
        loss = (square / self.error[cell]).mean()
        if self._lipschitz_penalty:
            bound = self._log_lipschitz()
            return {"loss": loss + self._lipschitz_penalty * bound, "error": error, "log_lipschitz": bound.detach()}
        return {"loss": loss, "error": error}

    def _slopes(self) -> list[torch.Tensor]:
        """Matrices of which the product of norms bounds the scaled estimate's Lipschitz constant with respect to z."""
        first, *others = (layer.weight for layer in self.network.linear_layers())
        return [first[:, : len(self._whiten)] @ self._whiten, *others]

    def _log_lipschitz(self) -> torch.Tensor:
        """Logarithm of that product; directions of largest gain are followed from batch to batch."""
        total = torch.zeros((), device=self.error.device)
        for i, weight in enumerate(self._slopes()):
            direction = getattr(self, f"direction{i}")
            with torch.no_grad():
                direction.copy_(nn.functional.normalize(weight.T @ (weight @ direction), dim=0))
            total = total + (weight @ direction).norm().log()
        return total
