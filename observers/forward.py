"""T: from the state to the filter's state, where it was learned."""

from dataclasses import dataclass

import numpy as np

from observers.errors import check_shapes
from observers.network import MLP


@dataclass(frozen=True)
class ForwardMap:
    """T: x -> z as learned, T(x) = z_offset + z_scale * mlp((x - x_offset) / x_scale).

    Parameters
    ----------
    mlp : MLP
        The network, of nx inputs and nz outputs.
    x_offset, x_scale : ndarray, shape (nx,)
        Scaling of the states.
    z_offset, z_scale : ndarray, shape (nz,)
        Scaling of the filter's state.
    """

    mlp: MLP
    x_offset: np.ndarray
    x_scale: np.ndarray
    z_offset: np.ndarray
    z_scale: np.ndarray

    def __post_init__(self) -> None:
        nx, nz = self.mlp.inputs, self.mlp.outputs
        check_shapes(self, {"x_offset": (nx,), "x_scale": (nx,), "z_offset": (nz,), "z_scale": (nz,)})

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Evaluate T. Shapes: ``x`` (..., nx); returns (..., nz)."""
        z = self.mlp((np.asarray(x, dtype=float) - self.x_offset) / self.x_scale)
        return self.z_offset + self.z_scale * z
