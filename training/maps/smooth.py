"""Maps as differentiable functions in float64: values, Jacobians, and the residual of the forward map's equation."""

from dataclasses import dataclass

import numpy as np

from kkl_gym.system import System
from observers import MLP, Artifact, ForwardMap


@dataclass(frozen=True)
class Smooth:
    """A multilayer perceptron between physical units: scalings are part of the first and the last layer.

    weights : for each layer (outputs, inputs), float64.
    biases : for each layer (outputs,).
    activation : after every layer but the last.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    activation: str

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(n, inputs) to (n, outputs)."""
        return self._forward(x)[0]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivatives at (n, inputs), as (n, outputs, inputs)."""
        _, slopes = self._forward(x)
        out = np.broadcast_to(self.weights[-1], (len(x), *self.weights[-1].shape))
        for weight, slope in zip(self.weights[-2::-1], slopes[::-1], strict=True):
            out = (out * slope[:, None]) @ weight
        return out

    def _forward(self, x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Values, and the slopes of the hidden layers' activations."""
        h, slopes = np.asarray(x, dtype=float), []
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            a = h @ weight.T + bias
            if self.activation == "tanh":
                h = np.tanh(a)
                slopes.append(1.0 - h * h)
            else:
                sigmoid = 0.5 + 0.5 * np.tanh(0.5 * a)
                h = a * sigmoid
                slopes.append(sigmoid * (1.0 + a * (1.0 - sigmoid)))
        return h @ self.weights[-1].T + self.biases[-1], slopes


def decoder(artifact: Artifact, measurement_noise: float, process_noise: float = 0.0) -> Smooth:
    """T_inv of free motion, long after reset, at given noise: filter states, (n, size), to estimates, (n, nx)."""
    inverse = artifact.free_inverse or artifact.inverse
    whiten = inverse.gain(measurement_noise)[:, None] * inverse.whiten
    told = inverse.noise_features(measurement_noise, process_noise)
    if "age" in inverse.features:
        told.append(float(inverse.age_feature(inverse.age_max)))
    first = inverse.mlp.weights[0].astype(float)
    modes = len(whiten)
    bias = inverse.mlp.biases[0] - first[:, :modes] @ whiten @ inverse.z_offset + first[:, modes:] @ np.array(told)
    filtered = np.zeros((len(first), artifact.filter.size))  # the part of z that holds inputs is 0
    filtered[:, : whiten.shape[1]] = first[:, :modes] @ whiten
    return _scaled(inverse.mlp, filtered, bias, inverse.x_scale, inverse.x_offset)


def encoder(forward: ForwardMap) -> Smooth:
    """T: states (n, nx) to (n, nz)."""
    first = forward.mlp.weights[0] / forward.x_scale
    return _scaled(
        forward.mlp, first, forward.mlp.biases[0] - first @ forward.x_offset, forward.z_scale, forward.z_offset
    )


def _scaled(mlp: MLP, first: np.ndarray, bias: np.ndarray, scale: np.ndarray, offset: np.ndarray) -> Smooth:
    weights, biases = [first, *mlp.weights[1:]], [bias, *mlp.biases[1:]]
    weights[-1], biases[-1] = scale[:, None] * weights[-1], offset + scale * biases[-1]
    return Smooth(
        tuple(np.asarray(w, float) for w in weights), tuple(np.asarray(b, float) for b in biases), mlp.activation
    )


def residual(artifact: Artifact, system: System, x: np.ndarray) -> np.ndarray:
    """P(x) = dT/dx f(x) - A T(x) - B h(x) at states (n, nx), (n, nz); needs a learned T."""
    if artifact.forward is None:
        raise ValueError("this observer holds no forward map T")
    T = encoder(artifact.forward)
    along = np.einsum("nij,nj->ni", T.jacobian(x), system.drift(x))
    return np.asarray(along - T(x) @ artifact.filter.A.T - system.output(x) @ artifact.filter.B.T)
