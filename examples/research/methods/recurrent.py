"""Linear filters whose spectrum is learned, differentiated through time."""

import numpy as np
import torch
from torch import nn
from torch.nn.functional import smooth_l1_loss

from examples.research.methods.base import Data
from observers import LinearFilter
from training.evaluation.levels import Level
from training.maps.coordinates import spread
from training.maps.networks import Network, tensor
from training.trajectories.motions import filter_states

TRAJECTORIES_PER_BATCH = 128
AGES_PER_BATCH = 32
SOFT_FLOOR = 1e-4
# Errors are taken absolutely, and squared within this part of a state's standard deviation. Squared all over, they are
# ruled by peaks: Rössler's x3 rests near 0.02 between spikes of 20.
ROUNDING = 0.01
# Of the spectrum's learning rate in the decoder's, which has to follow it.
SPECTRUM_PACE = 0.1


def distance(x_hat: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Mean absolute error of scaled estimates, rounded off near zero."""
    return smooth_l1_loss(x_hat, x, beta=ROUNDING)


def rollout(
    transition: torch.Tensor,
    early: torch.Tensor,
    late: torch.Tensor,
    *,
    z0: torch.Tensor,
    y: torch.Tensor,
    ages: np.ndarray,
) -> torch.Tensor:
    """Run z_k+1 = transition z_k + early y_k + late y_k+1 and take its states at some ages.

    Between two ages the filter moves in one jump, by powers of the transition, so that fifty seconds of samples cost
    no more operations than there are ages.

    Shapes: ``transition`` (nz, nz), ``early``, ``late`` (nz, ny), ``z0`` (n, nz), ``y`` (n, steps + 1, ny), ``ages``
    (m,); returns (m, n, nz).
    """
    gaps = np.diff(ages, prepend=0)
    powers = torch.eye(len(transition), dtype=transition.dtype, device=transition.device)[None]
    square = transition
    while len(powers) <= gaps.max():  # I, F, F^2, ... by doubling
        powers = torch.cat([powers, powers @ square])
        square = square @ square
    # w = z - late y follows w_k+1 = transition w_k + (early + transition late) y_k, with one sample of y in each step.
    response = (powers @ (early + transition @ late)).flip(0).transpose(1, 2)  # the oldest sample comes first
    w, out, age = z0 - y[:, 0] @ late.T, [], 0
    for gap, jump in zip(gaps.tolist(), powers[torch.as_tensor(gaps)].mT.unbind(), strict=True):
        if gap:
            kernel = response[len(response) - gap :].reshape(-1, len(transition))
            w = w @ jump + y[:, age : age + gap].reshape(len(y), -1) @ kernel
            age += gap
        out.append(w + y[:, age] @ late.T)
    return torch.stack(out)


class Decoder(nn.Module):
    """T_inv on z, in coordinates that the initial spectrum gives.

    The components of z are nearly collinear. Its principal directions are scaled to unit variance down to
    ``SOFT_FLOOR`` of the largest: full whitening would have to follow the spectrum as it is learned.
    """

    def __init__(self, network: Network, linear: LinearFilter, data: Data, *, device: torch.device) -> None:
        super().__init__()
        y = data.y[:, :500].astype(float)
        z = filter_states(linear, y, np.zeros((len(y) - 1, y.shape[1], 0)), data.ages).reshape(-1, linear.size)
        self.z_offset, scale = z.mean(0), spread(z)
        _, singular, directions = np.linalg.svd((z - self.z_offset) / scale, full_matrices=False)
        gain = np.sqrt(len(z)) / np.hypot(singular, SOFT_FLOOR * singular[0])
        self.whiten = gain[:, None] * directions / scale
        self.x_offset, self.x_scale = data.x.mean((0, 1)), data.x.std((0, 1))
        self.network = network.to(device)
        self._offset = torch.as_tensor(self.z_offset, device=device)
        self._whiten = torch.as_tensor(self.whiten, device=device)

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        """Scaled state estimates (..., nx) from z (..., nz) in double precision."""
        x: torch.Tensor = self.network(self.coordinates(z))
        return x

    def coordinates(self, z: torch.Tensor) -> torch.Tensor:
        """What the network sees of z."""
        return ((z - self._offset) @ self._whiten.T).float()


class Batches:
    """Random trajectories at random ages.

    Shapes: ``noise`` of length ny.
    """

    def __init__(self, data: Data, decoder: Decoder, *, noise: Level, device: torch.device) -> None:
        self._ages, self._noisy, self._noise = data.ages, np.any(noise), tensor(np.atleast_1d(noise), device)
        self._y = tensor(data.y.transpose(1, 0, 2), device)
        self._x = tensor((data.x - decoder.x_offset) / decoder.x_scale, device)

    def __call__(self, generator: torch.Generator) -> tuple[torch.Tensor, np.ndarray, torch.Tensor]:
        """Outputs (n, steps + 1, ny) in double precision, ages (m,), scaled states (m, n, nx)."""
        device = self._y.device
        rows = torch.randint(len(self._y), (TRAJECTORIES_PER_BATCH,), generator=generator, device=device)
        chosen = torch.randperm(len(self._ages), generator=generator, device=device)[:AGES_PER_BATCH].sort().values
        ages = self._ages[chosen.cpu().numpy()]
        y = self._y[rows, : ages[-1] + 1]
        if self._noisy:
            y = y + self._noise * torch.randn(y.shape, generator=generator, device=device)
        return y.double(), ages, self._x[chosen[:, None], rows]
