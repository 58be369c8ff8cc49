"""Maps as differentiable functions in float64: values and Jacobians."""

import numpy as np
import torch

from observers import MLP, Artifact, ForwardMap
from training.maps.networks import from_mlp

CHUNK = 4096  # points whose Jacobians are taken at once


class Smooth:
    """A multilayer perceptron between physical units, in float64 and differentiable."""

    def __init__(self, mlp: MLP) -> None:
        weights, biases = ([np.asarray(values, float) for values in part] for part in (mlp.weights, mlp.biases))
        self.mlp = MLP(weights, biases, mlp.activation)
        self.network = from_mlp(mlp, dtype=torch.float64)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(n, inputs) to (n, outputs)."""
        y: np.ndarray = self.network(torch.as_tensor(x, dtype=torch.float64)).numpy()
        return y

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivatives at (n, inputs), as (n, outputs, inputs)."""
        derivative = torch.func.vmap(torch.func.jacrev(self.network), chunk_size=CHUNK)
        J: np.ndarray = derivative(torch.as_tensor(x, dtype=torch.float64)).numpy()
        return J


def decoder(artifact: Artifact, measurement_noise: float | tuple[float, ...], process_noise: float = 0.0) -> Smooth:
    """T_inv of free motion long after reset, in physical units."""
    inverse = (artifact.free_inverse or artifact.inverse).part(slice(artifact.nx))
    whiten = inverse.gain(measurement_noise)[:, None] * inverse.whiten
    told = inverse.noise_features(measurement_noise, process_noise)
    if "age" in inverse.features:
        told.append(float(inverse.age_feature(inverse.age_max)))
    first = inverse.mlp.weights[0].astype(float)
    modes = len(whiten)
    bias = inverse.mlp.biases[0] - first[:, :modes] @ whiten @ inverse.z_offset + first[:, modes:] @ np.array(told)
    filtered = np.zeros((len(first), artifact.filter.size))  # the part of z that holds inputs is 0
    filtered[:, : whiten.shape[1]] = first[:, :modes] @ whiten
    return _scaled(inverse.mlp, filtered, bias, scale=inverse.x_scale, offset=inverse.x_offset)


def encoder(forward: ForwardMap) -> Smooth:
    """T in physical units: states (n, nx) to (n, nz)."""
    first = forward.mlp.weights[0] / forward.x_scale
    bias = forward.mlp.biases[0] - first @ forward.x_offset
    return _scaled(forward.mlp, first, bias, scale=forward.z_scale, offset=forward.z_offset)


def _scaled(mlp: MLP, first: np.ndarray, bias: np.ndarray, *, scale: np.ndarray, offset: np.ndarray) -> Smooth:
    weights, biases = [first, *mlp.weights[1:]], [bias, *mlp.biases[1:]]
    weights[-1], biases[-1] = scale[:, None] * weights[-1], offset + scale * biases[-1]
    return Smooth(MLP(weights, biases, mlp.activation))
