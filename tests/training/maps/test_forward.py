"""The forward map T and its equation, against finite differences and quadrature."""

import numpy as np
import pytest
import torch
from quadrature import backward_quadrature
from small_runs import CPU

from kkl_gym import ReverseDuffing, get_system
from observers import Artifact, LinearFilter
from training.maps.forward import ForwardProblem, on_tensors, truncation_time
from training.maps.networks import Network


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol", "rossler", "lorenz"])
def test_residual_is_the_pde_by_finite_differences(name):
    system = get_system(name)
    linear = LinearFilter(np.diag([-1.0, -2.0, -3.0]), np.ones((3, 1)), 0.01)
    rng = np.random.default_rng(0)
    low, high = system.box()
    x, z = rng.uniform(low, high, (100, system.nx)), rng.normal(size=(100, 3))
    torch.manual_seed(0)
    problem = ForwardProblem(
        Network(system.nx, 3, width=16, depth=2, activation="tanh"),
        system,
        linear=linear,
        x=x,
        z=z,
        physics_weight=1.0,
        batch=64,
        device=CPU,
    ).double()
    for attribute in ("_xo", "_xs", "_zo", "_zs", "_A", "_B"):
        setattr(problem, attribute, getattr(problem, attribute).double())
    points = torch.as_tensor(x[:10])
    f, h = on_tensors(system.f, points), on_tensors(system.h, points)
    eps = 1e-5 / (1.0 + f.norm(dim=-1, keepdim=True))
    derivative = (problem.T(points + eps * f) - problem.T(points - eps * f)) / (2 * eps)
    expected = derivative - problem.T(points) @ problem._A.T - h @ problem._B.T
    residual, _ = problem.residual(points)
    torch.testing.assert_close(residual.detach(), expected, rtol=1e-5, atol=1e-5)


def test_truncation_time_leaves_epsilon():
    A = np.array([[-1.0, 5.0], [0.0, -2.0]])
    linear = LinearFilter(A, np.ones((2, 1)), 0.01)
    t = truncation_time(linear, 10.0, 1e-6)
    poles, V = np.linalg.eig(A)
    left = np.linalg.norm((V * np.exp(poles * t)) @ np.linalg.inv(V), 2) * 10.0
    assert left <= 1e-6
    assert t == pytest.approx(np.log(np.linalg.cond(V) * 10.0 / 1e-6))


def test_backward_quadrature_solves_the_pde():
    eigenvalues, eps = [-1.5, -3.0], 1e-4
    x, system = np.array([1.2, -0.7]), ReverseDuffing()
    f = np.array(system.f(x))
    ahead, behind = (backward_quadrature(x + sign * eps * f, eigenvalues) for sign in (1, -1))
    derivative = (ahead - behind) / (2 * eps)
    np.testing.assert_allclose(derivative, eigenvalues * backward_quadrature(x, eigenvalues) + x[0], atol=1e-6)


def test_shipped_forward_map_of_reverse_duffing_against_backward_quadrature():
    from observers.artifact import resolve

    artifact = Artifact.read(resolve("reverse_duffing-spinn-v1"))
    eigenvalues = artifact.filter.A.diagonal()
    x = np.random.default_rng(0).uniform(*ReverseDuffing().box(), (60, 2))
    truth = np.array([backward_quadrature(point, eigenvalues) for point in x])
    error = artifact.forward(x) - truth
    assert np.sqrt((error**2).mean()) < 2e-2 * np.sqrt((truth**2).mean())
