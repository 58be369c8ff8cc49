"""Lipschitz constants of a network along straight lines, from above: how steep T_inv is where T is wrong."""

import numpy as np

from examples.research.certificates.lipschitz import SLOPES
from examples.research.certificates.smooth import Smooth
from observers.network import ACTIVATIONS

CHUNK = 256  # pieces whose enclosures are computed at once
SLACK = 0.5  # part by which a constant may be too large before its segment is cut further
HALVINGS = 10  # after which a piece is left as it is
_STEEPEST = 2.39936  # where x sigmoid(x) is at its steepest, and its negative where it falls fastest
_NEAR = 1e-5  # within which a place counts as the steepest


def segment_lipschitz(network: Smooth, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Bound a network's Lipschitz constant from above along each of some line segments.

    Shapes: ``start``, ``end`` (n, inputs); returns (n,).
    """
    constants, middles = np.zeros(len(start)), np.zeros(len(start))
    owner = np.arange(len(start))
    for halving in range(HALVINGS + 1):
        upper, middle = _enclose(network, (start + end) / 2, (end - start) / 2)
        np.maximum.at(middles, owner, middle)
        done = (upper <= (1.0 + SLACK) * middles[owner]) | (halving == HALVINGS)
        np.maximum.at(constants, owner[done], upper[done])
        left, right, owner = start[~done], end[~done], np.tile(owner[~done], 2)
        centre = (left + right) / 2
        start, end = np.concatenate([left, centre]), np.concatenate([centre, right])
        if not len(owner):
            break
    return constants * (1.0 + 1e-9)  # for the rounding of the arithmetic


def _enclose(network: Smooth, centre: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of |J| on the pieces centre +- half, (n,), and the norms of the middles of the enclosures, (n,)."""
    norms = [_chunk(network, centre[i : i + CHUNK], half[i : i + CHUNK]) for i in range(0, len(centre), CHUNK)]
    upper, middle = (np.concatenate(part) for part in zip(*norms, strict=True))
    return upper, middle


def _chunk(network: Smooth, centre: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first, *weights = network.mlp.weights
    bias, *biases = network.mlp.biases
    v = centre @ first.T + bias
    # The first column is the change over half a piece. The others are derivatives along the principal axes of the first
    # layer, which leave norms as they are and keep the directions that hardly matter apart.
    U, S, _ = np.linalg.svd(first, full_matrices=False)
    J = np.concatenate([(half @ first.T)[:, :, None], np.broadcast_to(U * S, (len(v), *U.shape))], axis=2)
    R = np.zeros_like(J)
    for weight, bias in zip(weights, biases, strict=True):
        radius = np.abs(J[:, :, :1]) + R[:, :, :1]
        low, high = slopes(v[:, :, None] - radius, v[:, :, None] + radius, network.mlp.activation)
        R = np.abs(weight) @ ((high - low) / 2 * np.abs(J) + np.maximum(np.abs(low), np.abs(high)) * R)
        J = weight @ ((low + high) / 2 * J)
        v = ACTIVATIONS[network.mlp.activation](v) @ weight.T + bias
    middle = np.linalg.norm(J[:, :, 1:], ord=2, axis=(1, 2))
    return middle + np.linalg.norm(R[:, :, 1:], ord=2, axis=(1, 2)), middle


def slopes(low: np.ndarray, high: np.ndarray, activation: str) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest slope of an activation on the intervals from ``low`` to ``high``."""
    least, greatest = SLOPES[activation]
    ends = [_slope(values, activation) for values in (low, high)]
    if activation == "tanh":
        return np.minimum(*ends), np.where((low <= 0.0) & (high >= 0.0), greatest, np.maximum(*ends))
    falls = (low <= -_STEEPEST + _NEAR) & (high >= -_STEEPEST - _NEAR)
    rises = (low <= _STEEPEST + _NEAR) & (high >= _STEEPEST - _NEAR)
    return np.where(falls, least, np.minimum(*ends)), np.where(rises, greatest, np.maximum(*ends))


def _slope(v: np.ndarray, activation: str) -> np.ndarray:
    if activation == "tanh":
        return np.asarray(1.0 - np.tanh(v) ** 2)
    sigmoid = 0.5 + 0.5 * np.tanh(0.5 * v)
    return np.asarray(sigmoid * (1.0 + v * (1.0 - sigmoid)))
