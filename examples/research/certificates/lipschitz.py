"""Lipschitz constants of networks, from below and from above, and of the output."""

import numpy as np
import torch

from examples.research.certificates.smooth import Smooth
from examples.research.derivatives import evaluate, jacobian
from kkl_gym.system import System

# Least and greatest slope of each activation, rounded outwards; those of x sigmoid(x) are where its second derivative
# vanishes, at |x| = 2.39936.
SLOPES = {"tanh": (0.0, 1.0), "silu": (-0.0998393202, 1.0998393202)}


def lipschitz_lower(network: Smooth, x: np.ndarray) -> tuple[float, np.ndarray]:
    """Bound a network's Lipschitz constant from below, over any convex set that holds some points.

    Shapes: ``x`` (n, inputs); returns ``at`` (inputs,).
    """
    norms = np.linalg.norm(network.jacobian(x), ord=2, axis=(1, 2))
    worst = int(norms.argmax())
    return float(norms[worst]), x[worst]


def lipschitz_upper(network: Smooth, steps: int = 150) -> float:
    """Bound a network's Lipschitz constant from above, everywhere, by a quadratic certificate for each layer."""
    if len(network.mlp.weights) == 1 or norm_product(network) == 0.0:
        return norm_product(network)
    low, high = SLOPES[network.mlp.activation]
    weights = [torch.as_tensor(weight, dtype=torch.float64) for weight in network.mlp.weights]
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


def output_lipschitz(system: System, x: np.ndarray) -> float:
    """Largest spectral norm of dh/dx at states (n, nx); ValueError if h does not take sympy symbols."""
    J = evaluate(jacobian(system.h, system.nx), x)
    return float(np.linalg.norm(J, ord=2, axis=(1, 2)).max())


def norm_product(network: Smooth) -> float:
    """Product of the layers' spectral norms and the activations' largest slopes, a bound that costs no work."""
    slope = max(abs(value) for value in SLOPES[network.mlp.activation])
    return float(np.prod([np.linalg.norm(weight, 2) for weight in network.mlp.weights])) * slope ** (
        len(network.mlp.weights) - 1
    )
