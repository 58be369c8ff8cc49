"""The forward map T by linear least squares, in place of gradients."""

import numpy as np
import torch
from scipy.linalg import qr, solve_triangular

from kkl_gym.system import System
from observers import MLP, ForwardMap, LinearFilter
from training.maps.collocation import collocation
from training.maps.pde import along

POINTS = 8  # collocation points for each feature
STEEPNESS = 5.0  # of the features at the centre of the points; it falls with the distance from there
RIDGE = 1e-5


def solve_forward(
    system: System, linear: LinearFilter, *, features: int, box_factor: float, rng: np.random.Generator
) -> ForwardMap:
    """Solve for T with random features and an output layer that fulfils the PDE in the mean square.

    With A diagonal, dT/dx f = A T + B h is one linear equation for each component of T. For T_i = w . phi(x) with fixed
    features phi it becomes (dphi/dx f - lambda_i phi) . w = (B h)_i at every collocation point: linear least squares,
    solved in float64 by a QR factorisation with a small ridge. Rows are divided by the local speed plus the rate of the
    mode, as in :class:`training.maps.forward.ForwardProblem`. No filter is simulated.

    Collocation points lie along motions, because the equation transports T along them: a box that motions leave and
    enter holds T only up to what came in, and its corners are where it then goes wrong.

    Parameters
    ----------
    system : System
        The system.
    linear : LinearFilter
        Its filter, A diagonal.
    features : int
        Number of tanh units; the time grows with their cube, a minute for 1,500.
    box_factor : float
        Motions start in this multiple of X.
    rng : Generator
        Of features and points.

    Returns
    -------
    ForwardMap
        T.

    Raises
    ------
    ValueError
        If A is not diagonal, or hardly any motion stays within the system's bounds.
    """
    if np.count_nonzero(linear.A - np.diag(linear.A.diagonal())):
        raise ValueError("solving for T component by component needs a diagonal A")
    x = collocation(system, POINTS * features, box_factor=box_factor, rng=rng)
    f, offset, scale = system.drift(x), x.mean(0), x.std(0)
    q = (x - offset) / scale
    centres = q[rng.integers(len(q), size=features)]
    weights = rng.standard_normal((features, system.nx))
    weights *= (STEEPNESS / (1.0 + np.linalg.norm(centres, axis=1)))[:, None]
    biases = -(centres * weights).sum(1)

    def hidden(q: torch.Tensor) -> torch.Tensor:
        return torch.tanh(q @ torch.as_tensor(weights.T) + torch.as_tensor(biases))

    value, derivative = along(hidden, torch.as_tensor(q), torch.as_tensor(f / scale))
    phi, phi_along = np.column_stack([value, np.ones(len(x))]), np.column_stack([derivative, np.zeros(len(x))])
    speed, driven = np.linalg.norm(f / scale, axis=1), system.output(x) @ linear.B.T
    solved = np.empty((len(linear.A), features + 1))
    for i, pole in enumerate(linear.A.diagonal()):
        row = 1.0 / (speed + abs(pole))
        matrix = (phi_along - pole * phi) * row[:, None]
        ridge = RIDGE * np.linalg.norm(matrix) / np.sqrt(features) * np.eye(features + 1)
        Q, R = qr(np.vstack([matrix, ridge]), mode="economic", overwrite_a=True, check_finite=False)
        solved[i] = solve_triangular(R, Q[: len(x)].T @ (driven[:, i] * row))
    size = np.maximum(np.abs(solved).max(1), 1e-12)
    mlp = MLP(
        [weights.astype(np.float32), (solved[:, :-1] / size[:, None]).astype(np.float32)],
        [biases.astype(np.float32), (solved[:, -1] / size).astype(np.float32)],
        "tanh",
    )
    return ForwardMap(mlp, offset, scale, np.zeros(len(size)), size)
