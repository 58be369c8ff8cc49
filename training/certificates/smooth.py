"""Networks as differentiable functions in float64: values, Jacobians and Lipschitz constants."""

from dataclasses import dataclass

import numpy as np
import torch

from observers import MLP, Artifact, ForwardMap

# Least and greatest slope of each activation, rounded outwards; those of x sigmoid(x) are where its second derivative
# vanishes, at |x| = 2.39936.
SLOPES = {"tanh": (0.0, 1.0), "silu": (-0.0998393202, 1.0998393202)}


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
    inverse = artifact.free or artifact.inverse
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


def lipschitz_lower(network: Smooth, x: np.ndarray) -> tuple[float, np.ndarray]:
    """The largest spectral norm of the Jacobian among the points (n, inputs), and the point where it is.

    No Lipschitz constant over a convex set that holds these points is smaller.
    """
    norms = np.linalg.norm(network.jacobian(x), ord=2, axis=(1, 2))
    worst = int(norms.argmax())
    return float(norms[worst]), x[worst]


def lipschitz_upper(network: Smooth, steps: int = 150) -> float:
    """A constant that no two inputs anywhere exceed, by a quadratic certificate for each layer.

    Let M be a matrix with |f(h) - f(h')|^2 <= (h - h')^T M (h - h') for everything behind a layer h = phi(W x + b).
    With activations of slopes between a and b, and any positive diagonal D with D - M > 0, the same holds in
    front of it for W^T [(a + b)^2/4 D (D - M)^-1 D - a b D] W (the S-procedure on (dh - a dv)^T D (b dv - dh) >= 0,
    then a Schur complement). Beginning at W^T W of the last layer this leads to the input, where the largest eigenvalue
    is the square of the constant. Fazlyab et al. (NeurIPS 2019) pose it as one semidefinite program, Xu and Sivaranjani
    (ECLipsE, NeurIPS 2024) layer by layer; here the diagonals of all layers are found together by gradients, so that no
    solver of such programs is needed. Every choice of them is sound; a good one is less than the product of norms.
    """
    if len(network.weights) == 1 or norm_product(network) == 0.0:
        return norm_product(network)
    low, high = SLOPES[network.activation]
    weights = [torch.as_tensor(weight, dtype=torch.float64) for weight in network.weights]
    # D is a shape about the diagonal of M, times the least factor with D >= M, times 1 + e^margin: always admissible.
    # Zeros are a good start: for diagonal M they give D = 2 M, with which nothing is lost.
    shapes = [torch.zeros(len(weight), dtype=torch.float64, requires_grad=True) for weight in weights[:-1]]
    margins = [torch.zeros((), dtype=torch.float64, requires_grad=True) for _ in weights[:-1]]

    def bound() -> torch.Tensor:
        M = weights[-1].T @ weights[-1]
        for weight, shape, margin in zip(weights[-2::-1], shapes[::-1], margins[::-1], strict=True):
            root = torch.exp(shape / 2) * torch.sqrt(M.diagonal() + 1e-6 * M.diagonal().max())
            factor = torch.linalg.eigvalsh(M / root[:, None] / root)[-1]
            D = root**2 * factor * (1.0 + torch.exp(margin))
            inner = torch.linalg.solve(torch.diag(D) - M, torch.diag(D))
            M = weight.T @ ((low + high) ** 2 / 4 * D[:, None] * inner - low * high * torch.diag(D)) @ weight
            M = (M + M.T) / 2
        largest: torch.Tensor = torch.linalg.eigvalsh(M)[-1]
        return largest

    optimiser = torch.optim.Adam([*shapes, *margins], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    best = float("inf")
    for _ in range(steps):
        optimiser.zero_grad()
        squared = bound()
        best = min(best, float(squared.detach()))
        torch.log(squared).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    best = min(best, float(bound().detach()))
    certified = float(np.sqrt(best)) * (1.0 + 1e-9)  # for the rounding of the arithmetic above
    return min(certified, norm_product(network))


def norm_product(network: Smooth) -> float:
    """The product of the layers' spectral norms and the activations' largest slope, what is known without work."""
    slope = max(abs(value) for value in SLOPES[network.activation])
    return float(np.prod([np.linalg.norm(weight, 2) for weight in network.weights])) * slope ** (
        len(network.weights) - 1
    )
