"""``python -m examples.research lipschitz``: a rigorous bound on how much an error of z changes an estimate."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from observers import MLP, Artifact
from training.commands.options import NoiseLevel, Observers, OwnSystem, read_observers
from training.evaluation.errors import unseen_trajectories
from training.evaluation.levels import Level, beyond, level_for
from training.maps.networks import from_mlp
from training.trajectories.motions import filter_states

# Least and largest slope of each activation, rounded outwards. Those of silu, x sigmoid(x), are at the zeros of its
# second derivative, |x| = 2.39936.
SLOPES = {"tanh": (0.0, 1.0), "silu": (-0.0998393202, 1.0998393202)}
STEPS = 150  # optimisation steps of the search for the certificate
TRIALS, EVERY = 50, 20  # number of motions along which Jacobians are computed, and samples between two Jacobians
CHUNK = 4096  # points whose Jacobians are computed together


@dataclass(frozen=True)
class Lipschitz:
    """Bound the Lipschitz constant of T_inv: |x_hat(z + d) - x_hat(z)| <= constant |d| for all z and d.

    The bounds hold for T_inv as an observer uses it long after a reset if no input has acted. The lower bound is the
    largest norm of T_inv's Jacobians along unseen motions.
    """

    observers: Observers
    """Shipped maps, or .safetensors files."""
    system: OwnSystem = None
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise that the map assumes, or one for each output as in 0.1,0.3."""

    def run(self, console: Console) -> Table:
        """Print the bounds."""
        table = Table("", "at least", "at most", "product of the layers' norms")
        for name, (_, artifact, system) in zip(
            self.observers, read_observers(self.observers, self.system), strict=True
        ):
            level = level_for(artifact, system, self.measurement_noise)
            if reason := beyond(artifact, level):
                raise ValueError(f"{name}: {reason}")
            mlp = decoder(artifact, level)
            lower = lipschitz_lower(mlp, along_motions(artifact, system))
            figures = (lower, lipschitz_upper(mlp), norm_product(mlp))
            table.add_row(Path(name).stem, *(f"{figure:.3g}" for figure in figures))
        console.print(table)
        return table


def decoder(artifact: Artifact, measurement_noise: Level) -> MLP:
    """Return T_inv for motion without input, long after reset, as a network from z to x in physical units."""
    inverse = (artifact.free_inverse or artifact.inverse).part(slice(artifact.nx))
    whiten = inverse.gain(measurement_noise)[:, None] * inverse.whiten
    features = inverse.noise_features(measurement_noise, 0.0)
    if "age" in inverse.features:
        features.append(float(inverse.age_feature(inverse.age_max)))
    weights = [np.asarray(weight, float) for weight in inverse.mlp.weights]
    biases = [np.asarray(bias, float) for bias in inverse.mlp.biases]
    first, modes = weights[0], len(whiten)
    biases[0] = biases[0] - first[:, :modes] @ whiten @ inverse.z_offset + first[:, modes:] @ np.array(features)
    weights[0] = np.zeros((len(first), artifact.filter.size))  # z_u is 0 without input
    weights[0][:, : whiten.shape[1]] = first[:, :modes] @ whiten
    weights[-1], biases[-1] = inverse.x_scale[:, None] * weights[-1], inverse.x_offset + inverse.x_scale * biases[-1]
    return MLP(weights, biases, inverse.mlp.activation)


def along_motions(artifact: Artifact, system: System) -> np.ndarray:
    """Return filter states (n, nz) of unseen motions without noise, after the transient."""
    linear, duration = artifact.filter, system.duration
    x = unseen_trajectories(system, linear.dt, n=TRIALS, duration=duration, seed=0).x
    ages = np.arange(len(x) // 5, len(x), EVERY)
    z: np.ndarray = filter_states(linear, system.output(x), np.zeros((len(x) - 1, x.shape[1], linear.nu)), ages)
    return z.reshape(-1, linear.size)


def lipschitz_lower(mlp: MLP, z: np.ndarray) -> float:
    """Return a lower bound of a network's Lipschitz constant, from its Jacobians at points (n, inputs)."""
    network = from_mlp(mlp, dtype=torch.float64)
    derivative = torch.func.vmap(torch.func.jacrev(network), chunk_size=CHUNK)
    return float(torch.linalg.matrix_norm(derivative(torch.as_tensor(z, dtype=torch.float64)), 2).max())


def lipschitz_upper(mlp: MLP, steps: int = STEPS) -> float:
    """Return a global upper bound of a network's Lipschitz constant, by a quadratic certificate for each layer.

    M. Fazlyab et al., "Efficient and accurate estimation of Lipschitz constants for deep neural networks", NeurIPS
    2019, layer by layer as in Y. Xu and S. Sivaranjani, "ECLipsE", NeurIPS 2024.
    """
    if len(mlp.weights) == 1 or norm_product(mlp) == 0.0:
        return norm_product(mlp)
    low, high = SLOPES[mlp.activation]
    weights = [torch.as_tensor(weight, dtype=torch.float64) for weight in mlp.weights]
    # A change d of a layer changes the output by at most sqrt(d^T M d). M and any diagonal D > M give M of the layer
    # before. D is diag(M) e^shape, scaled to the least D >= M, times 1 + e^margin. At first D = 2 M if M is diagonal.
    shapes = [torch.zeros(len(weight), dtype=torch.float64, requires_grad=True) for weight in weights[:-1]]
    margins = [torch.zeros((), dtype=torch.float64, requires_grad=True) for _ in weights[:-1]]

    def squared() -> torch.Tensor:
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
        bound = squared()
        best = min(best, float(bound.detach()))
        torch.log(bound).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    best = min(best, float(squared().detach()))
    return min(float(np.sqrt(best)) * (1.0 + 1e-9), norm_product(mlp))  # the factor covers rounding


def norm_product(mlp: MLP) -> float:
    """Return the product of the layers' spectral norms and the activations' largest slopes, a simple upper bound."""
    slope = max(abs(value) for value in SLOPES[mlp.activation])
    return float(np.prod([np.linalg.norm(weight, 2) for weight in mlp.weights])) * slope ** (len(mlp.weights) - 1)
