"""The terms C_eta and C_theta of the paper's theorem 2: what may be lost between the sample and the population."""

import math
from collections.abc import Mapping
from typing import Any

from observers import MLP


def pseudo_dimension_bound(mlp: MLP) -> float:
    """Bound the pseudo-dimension of {(x, y) -> |y - mlp(x)|^2} over all weights from above.

    Parameters
    ----------
    mlp : MLP
        A network of the set.

    Returns
    -------
    float
        The bound.

    Notes
    -----
    Anthony and Bartlett, Neural Network Learning (1999), theorem 8.14: a set of functions of d parameters, each
    computed by t operations (sums, products, quotients, comparisons) of which q are exponentials, has
    VC dimension at most (d (q + 1))^2 + 11 d (q + 1) (t + log2(9 d (q + 1))). The pseudo-dimension is the VC dimension
    of the functions' subgraphs, which a last comparison with a given threshold makes of them. A unit of tanh or
    x sigmoid(x) takes one exponential and at most four more operations.
    """
    parameters = sum(weight.size + bias.size for weight, bias in zip(mlp.weights, mlp.biases, strict=True))
    units = sum(len(bias) for bias in mlp.biases[:-1])
    operations = 2 * parameters + 5 * units + 3 * mlp.outputs + 1
    product = parameters * (units + 1)
    return float(product**2 + 11 * product * (operations + math.log2(9 * product)))


def generalisation_term(largest_loss: float, *, pseudo_dimension: float, samples: int, delta: float) -> float:
    """Bound how far the risk may lie above its mean on a sample (paper, sec. 4.3).

    Parameters
    ----------
    largest_loss : float
        Bound M of the loss.
    pseudo_dimension : float
        That of the losses, d.
    samples : int
        Their number, N.
    delta : float
        Probability with which the bound may fail.

    Returns
    -------
    float
        M sqrt(2 d ln(e N/d) / N) + M sqrt(ln(1/delta) / 2N), infinite where N < d: then nothing is said.
    """
    if samples < pseudo_dimension:
        return math.inf
    complexity = math.sqrt(2 * pseudo_dimension * math.log(math.e * samples / pseudo_dimension) / samples)
    return largest_loss * (complexity + math.sqrt(math.log(1 / delta) / (2 * samples)))


def forward_samples(training: Mapping[str, Any]) -> int:
    """N_1, the samples of S_1: what an artifact's training says of distinct pairs (x, z) and collocation points.

    Files that do not say it count as many as they recorded, trajectories times samples, without collocation points.
    """
    return int(training.get("forward_samples", _recorded(training)))


def inverse_samples(training: Mapping[str, Any]) -> int:
    """N_2, the samples of S_2: what an artifact's training says of distinct x' that its T_inv could see.

    Files that do not say it count as many as they recorded; so do maps that are fitted along trajectories.
    """
    return int(training.get("inverse_samples", _recorded(training)))


def _recorded(training: Mapping[str, Any]) -> int:
    return int(training.get("trajectories", 0)) * int(training.get("samples", 0))
