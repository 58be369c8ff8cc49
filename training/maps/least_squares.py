"""The output layer of the forward map T by linear least squares, in place of gradients."""

from collections.abc import Callable

import numpy as np
import torch
from scipy.linalg import qr, solve_triangular

from kkl_gym.system import System
from observers import MLP, ForwardMap, LinearFilter
from training.maps.coordinates import spread
from training.maps.pde import along

POINTS = 8  # collocation points for each random feature
STEEPNESS = 5.0  # of the features at the centre of the points; it falls with the distance from there
RIDGE = 1e-5


def output_layer(
    linear: LinearFilter,
    *,
    equation: tuple[np.ndarray, np.ndarray, np.ndarray],
    speed: np.ndarray,
    pairs: tuple[np.ndarray, np.ndarray] | None = None,
    physics_weight: float = 1.0,
    report: Callable[[int], object] = lambda done: None,
) -> np.ndarray:
    """Solve for the weights with which fixed features phi make T(x) = W [phi(x), 1].

    In the coordinates of A's eigenvectors, dT/dx f = A T + B h is one linear equation for each component of T: with
    T_i = w . phi it becomes (dphi/dx f - lambda_i phi) . w = (B h)_i at every collocation point. Pairs add T_i = z_i.
    Both are solved in the mean square, in float64 by a QR factorisation with a small ridge. As in
    :class:`training.maps.forward.ForwardProblem`, the equation's rows are divided by the local speed plus the rate of
    the mode.

    Shapes: ``equation`` (m, features), (m, features) and (m, ny), ``speed`` (m,), ``pairs`` (n, features) and (n, nz);
    returns (nz, features + 1).
    """
    value, derivative, h = equation
    phi, phi_along = np.column_stack([value, np.ones(len(value))]), np.column_stack([derivative, np.zeros(len(value))])
    poles, V = np.linalg.eig(linear.A)
    driven = np.linalg.solve(V, linear.B @ h.T).T
    known, target = np.empty((0, phi.shape[1])), np.empty((0, len(poles)))
    if pairs is not None:
        known = np.column_stack([pairs[0], np.ones(len(pairs[0]))]) / np.sqrt(len(pairs[0]))
        target = np.linalg.solve(V, pairs[1].T).T / np.sqrt(len(pairs[0]))
    solved = np.empty((len(poles), phi.shape[1]), dtype=V.dtype)
    for i, pole in enumerate(poles):
        report(i)
        row = np.sqrt(physics_weight / len(phi)) / (speed + abs(pole))
        matrix = np.vstack([(phi_along - pole * phi) * row[:, None], known])
        ridge = RIDGE * np.linalg.norm(matrix) / np.sqrt(phi.shape[1]) * np.eye(phi.shape[1])
        right = np.concatenate([driven[:, i] * row, target[:, i]])
        Q, R = qr(np.vstack([matrix, ridge]), mode="economic", overwrite_a=True, check_finite=False)
        solved[i] = solve_triangular(R, Q[: len(right)].conj().T @ right)
    return np.real(V @ solved)


def solve_forward(
    system: System,
    linear: LinearFilter,
    *,
    features: int,
    points: np.ndarray,
    rng: np.random.Generator,
    report: Callable[[int], object] = lambda done: None,
) -> ForwardMap:
    """Solve for T with random features, from its equation alone.

    Collocation points should lie along motions, because the equation transports T along them: a box that motions leave
    and enter holds T only up to what came in, and its corners are where it then goes wrong.
    """
    x = points[rng.permutation(len(points))[: POINTS * features]]
    offset, scale = x.mean(0), np.where(x.std(0) > 0, x.std(0), 1.0)
    q, f = (x - offset) / scale, system.drift(x) / scale
    centres = q[rng.integers(len(q), size=features)]
    weights = rng.standard_normal((features, system.nx))
    weights *= (STEEPNESS / (1.0 + np.linalg.norm(centres, axis=1)))[:, None]
    biases = -(centres * weights).sum(1)

    def hidden(q: torch.Tensor) -> torch.Tensor:
        return torch.tanh(q @ torch.as_tensor(weights.T) + torch.as_tensor(biases))

    value, derivative = along(hidden, torch.as_tensor(q), torch.as_tensor(f))
    solved = output_layer(
        linear,
        equation=(value.numpy(), derivative.numpy(), system.output(x)),
        speed=np.linalg.norm(f, axis=1),
        report=report,
    )
    z = value.numpy() @ solved[:, :-1].T + solved[:, -1]
    middle, size = z.mean(0), spread(z)
    mlp = MLP(
        [weights.astype(np.float32), (solved[:, :-1] / size[:, None]).astype(np.float32)],
        [biases.astype(np.float32), ((solved[:, -1] - middle) / size).astype(np.float32)],
        "tanh",
    )
    return ForwardMap(mlp, offset, scale, middle, size)
