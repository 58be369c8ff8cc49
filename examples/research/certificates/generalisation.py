"""The terms C_eta and C_theta of the paper's theorem 2: what may be lost between the sample and the population."""

import math
from collections.abc import Mapping
from typing import Any

from observers import MLP


def pseudo_dimension_bound(mlp: MLP) -> float:
    """Bound the pseudo-dimension of {(x, y) -> |y - mlp(x)|^2} over all weights from above."""
    parameters = sum(weight.size + bias.size for weight, bias in zip(mlp.weights, mlp.biases, strict=True))
    units = sum(len(bias) for bias in mlp.biases[:-1])
    operations = 2 * parameters + 5 * units + 3 * mlp.outputs + 1
    product = parameters * (units + 1)
    return float(product**2 + 11 * product * (operations + math.log2(9 * product)))


def generalisation_term(largest_loss: float, *, pseudo_dimension: float, samples: int, delta: float) -> float:
    """Bound how far the risk may lie above its mean on a sample (paper, sec. 4.3)."""
    if samples < pseudo_dimension:
        return math.inf
    complexity = math.sqrt(2 * pseudo_dimension * math.log(math.e * samples / pseudo_dimension) / samples)
    return largest_loss * (complexity + math.sqrt(math.log(1 / delta) / (2 * samples)))


def forward_samples(training: Mapping[str, Any]) -> int:
    """N_1, the samples of S_1: distinct pairs (x, z) and collocation points in an artifact's training."""
    return int(training.get("forward_samples", 0))


def inverse_samples(training: Mapping[str, Any]) -> int:
    """N_2, the samples of S_2: distinct x' in an artifact's training; along trajectories, all recorded states."""
    recorded = int(training.get("trajectories", 0)) * int(training.get("samples", 0))
    return int(training.get("inverse_samples", recorded))
