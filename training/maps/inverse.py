"""The inverse T_inv as a network: what its training minimises."""

import torch
from torch import nn

from training.maps.networks import Network
from training.maps.samplers import Sampler


class InverseProblem(nn.Module):
    """The inverse network with the running mean square error of each cell.

    Parameters
    ----------
    network : Network
        From a batch's inputs to scaled states.
    sampler : Sampler
        Where batches are from.
    device : torch.device
        Where the network is trained.
    """

    def __init__(self, network: Network, sampler: Sampler, device: torch.device) -> None:
        super().__init__()
        self.network = network
        self.sampler = sampler
        self.register_buffer("error", torch.ones(sampler.cells, device=device))
        self.register_buffer("visited", torch.zeros(sampler.cells, dtype=torch.bool, device=device))
        self.error: torch.Tensor
        self.visited: torch.Tensor

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean square error of a batch, each cell relative to its own running error.

        Parameters
        ----------
        generator : torch.Generator
            Of the batch.

        Returns
        -------
        dict of str to Tensor
            "loss", which stays near one while all cells improve, and "error", the geometric mean of the cells' root
            mean square errors in scaled states, which falls.
        """
        inputs, x, weight, cell = self.sampler(generator)
        square = weight * ((self.network(inputs) - x) ** 2).mean(-1)
        if len(self.error) == 1:
            return {"loss": square.mean(), "error": square.detach().mean().sqrt()}
        detached = square.detach()
        count = torch.zeros_like(self.error).index_add_(0, cell, torch.ones_like(detached))
        mean = torch.zeros_like(self.error).index_add_(0, cell, detached) / count.clamp(min=1.0)
        keep = torch.where(count > 0, 0.99, 1.0)
        self.error.mul_(keep).add_((1 - keep) * mean)
        self.visited |= count > 0  # there may be cells without data
        error = self.error[self.visited].log().mean().exp().sqrt()
        return {"loss": (square / self.error[cell]).mean(), "error": error}
