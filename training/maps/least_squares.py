"""The output layer of the forward map T by linear least squares, in place of gradients."""

from collections.abc import Callable

import numpy as np
from scipy.linalg import qr, solve_triangular

from observers import LinearFilter

RIDGE = 1e-5


def output_layer(
    linear: LinearFilter,
    *,
    equation: tuple[np.ndarray, np.ndarray, np.ndarray],
    speed: np.ndarray,
    pairs: tuple[np.ndarray, np.ndarray],
    physics_weight: float,
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
