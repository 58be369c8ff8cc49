"""Batches that a forward map makes: states and what it gives for them."""

import numpy as np
import torch

from observers import InverseMap, LinearFilter
from training.config import Scaling
from training.maps.coordinates import coordinates
from training.maps.networks import Network, tensor
from training.maps.pde import TensorMap
from training.maps.samplers.batch import Batch
from training.maps.scaling import StateScale


class ForwardMapSampler:
    """The paper's second data set S_2: drawn x', z' = T(x') by the map (sec. 5.2), without transients.

    The filter's z differs from T(x) by the error of T, which an inverse fitted to T(x') alone would magnify by its
    Lipschitz constant (paper, lemma R-eta-bound). z' is therefore blurred by Gaussian noise with the covariance of that
    error, measured on the forward map's own data, and each coordinate is shrunk to its linear conditional mean.

    Shapes: ``error`` (n, nz), ``points`` (n, nx).
    """

    cells, kinds_of_plant = 1, 1
    parameters = 0

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
        self._points, self._weight = tensor(points, device), tensor(self.scale.weight(points), device)
        self._forward, self._batch = forward, batch
        x = self._points[self._draw(torch.Generator(device).manual_seed(0), 100_000)]
        with torch.no_grad():
            z = forward(x).cpu().numpy().astype(float)
        self.coordinates = coordinates(z, error.T @ error / len(error))
        self._offset, self._scale = tensor(self.scale.offset, device), tensor(self.scale.scale, device)
        self._z_offset = torch.as_tensor(self.coordinates.offset, device=device)
        self._whiten = torch.as_tensor(self.coordinates.whiten, device=device)
        self._blur = tensor(self.coordinates.noise_gain, device)

    def _draw(self, generator: torch.Generator, n: int) -> torch.Tensor:
        return torch.randint(len(self._points), (n,), generator=generator, device=generator.device)

    @torch.no_grad()
    def __call__(self, generator: torch.Generator) -> Batch:
        """One batch."""
        rows = self._draw(generator, self._batch)
        x = self._points[rows]
        modes = ((self._forward(x).double() - self._z_offset) @ self._whiten.T).float()
        modes = modes + self._blur * torch.randn(modes.shape, generator=generator, device=x.device)
        modes = modes / (1.0 + self._blur**2)
        cell = torch.zeros(len(x), dtype=torch.long, device=x.device)
        return Batch(modes, (x - self._offset) / self._scale, self._weight[rows], cell)

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
