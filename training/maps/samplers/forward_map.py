"""Batches that a forward map makes: states and what it gives for them."""

import numpy as np
import torch

from observers import InverseMap, LinearFilter
from training.maps.coordinates import coordinates
from training.maps.networks import Network, tensor
from training.maps.pde import TensorMap
from training.maps.samplers.batch import Batch


class ForwardMapSampler:
    """The paper's second data set S_2: x' uniform in the training box (or given), z' = T(x') by the map (sec. 5.2).

    The filter's z differs from T(x) by the error of T, which an inverse fitted to T(x') alone would magnify by its
    Lipschitz constant (paper, lemma R-eta-bound). z' is therefore blurred by Gaussian noise with the covariance of that
    error, measured on the forward map's own data, and each coordinate is shrunk to its linear conditional mean.

    Parameters
    ----------
    forward : callable
        T on tensors, (n, nx) to (n, nz).
    error : ndarray, shape (n, nz)
        Samples of z - T(x).
    box : tuple of ndarray, shapes (nx,)
        Low and high corner of where x' is drawn.
    batch : int
        Samples in a batch.
    device : torch.device
        Where batches are made.
    points : ndarray, shape (n, nx), optional
        States of which x' is drawn instead.

    Attributes
    ----------
    coordinates : Coordinates
        In which the network sees z.
    x_offset, x_scale : ndarray, shape (nx,)
        Middle and half-width of the box, or of that of the points.
    """

    cells = 1

    def __init__(
        self,
        forward: TensorMap,
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
        cell = torch.zeros(len(x), dtype=torch.long, device=x.device)
        return Batch(modes, (x - self._offset) / self._scale, ones, cell)

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
