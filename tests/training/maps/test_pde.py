"""The equation of the forward map on tensors, where derivatives and solutions are known."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from kinked_systems import SYSTEMS as KINKED
from linear_system import C, F, Oscillator, sylvester
from random_artifacts import random_artifact
from wrong_systems import Branching, Late

from kkl_gym import EquationError, get_system
from kkl_gym.system import on_states
from observers import ForwardMap
from training.maps.forward import ForwardProblem
from training.maps.networks import Network, from_mlp
from training.maps.pde import along, on_tensors, residual
from training.maps.scaling import StateScale
from training.maps.smooth import Smooth, encoder
from training.maps.smooth import residual as residual_of
from training.trajectories.equations import evaluate, jacobian

A, B = torch.diag(torch.tensor([-1.0, -2.5, -4.0], dtype=torch.float64)), torch.ones(3, 1, dtype=torch.float64)


def points(system, n=20):
    return torch.as_tensor(np.random.default_rng(0).uniform(*system.box(), (n, system.nx)))


@pytest.mark.parametrize("system", ["lorenz", *KINKED], ids=str)
def test_equations_on_tensors_are_those_on_arrays(system):
    system = get_system(system)
    x = points(system)
    for equations in (system.f, system.h):
        np.testing.assert_allclose(on_tensors(equations, x).numpy(), on_states(equations, x.numpy()), rtol=1e-14)
    mixed = on_tensors(lambda x: (1.0, x[0], 2), x.float())
    assert mixed.dtype == torch.float32
    np.testing.assert_array_equal(mixed.numpy(), np.stack([np.ones(20), x[:, 0].float(), np.full(20, 2.0)], 1))


@pytest.mark.parametrize(
    ("equations", "message"),
    [
        (Late().f, "; x held tensors of shape (4,): use kkl_gym.elementary.sin, which serves"),
        (Branching().f, "; x held tensors of shape (4,), on which `if`, `and`, `or` and `not` cannot decide: use"),
        (lambda x: (x[0], x[1].reshape(2, 2)), "of which [1] is of shape (2, 2), where the components of x have shape"),
        (lambda x: torch.complex(x[0], x[1])[None], "which is complex"),
    ],
)
def test_equations_that_take_no_tensors_are_named(equations, message):
    with pytest.raises(EquationError, match=re.escape(message)):
        on_tensors(equations, torch.zeros(4, 2, requires_grad=True))


@pytest.mark.parametrize("system", KINKED, ids=str)
def test_gradients_of_tensors_are_the_derivatives_of_symbols(system):
    x = points(system).requires_grad_()
    for equations in (system.f, system.h):
        expected = evaluate(jacobian(equations, system.nx), x.detach().numpy())
        for i, component in enumerate(on_tensors(equations, x).T):
            (slope,) = torch.autograd.grad(component.sum(), x, retain_graph=True, materialize_grads=True)
            np.testing.assert_allclose(slope.numpy(), expected[:, i], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_derivatives_along_a_field_by_hand_are_those_of_forward_mode(activation):
    x, f = torch.randn(2, 10, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    network = Network(3, 2, width=8, depth=2, activation=activation).double()
    expected = torch.func.jvp(network, (x,), (f,))
    torch.testing.assert_close(along(network, x, f), expected)
    with pytest.raises(TypeError, match="no derivative of ReLU"):
        along(torch.nn.Sequential(torch.nn.ReLU()), x, f)


def test_the_solution_leaves_nothing_and_another_map_what_it_is_off_by():
    system, x = Oscillator(), points(Oscillator())
    M = torch.as_tensor(sylvester(A.numpy(), B.numpy()))
    f, given = on_tensors(system.f, x), {"h": on_tensors(system.h, x), "A": A, "B": B}
    np.testing.assert_allclose(residual(x @ M.T, f @ M.T, **given), np.zeros((20, 3)), atol=1e-14)
    wrong = M + 0.1
    expected = x @ (wrong @ torch.as_tensor(F) - A @ wrong - B @ torch.as_tensor(C)).T - 0.2 * A.sum(1)
    np.testing.assert_allclose(residual(x @ wrong.T + 0.2, f @ wrong.T, **given), expected, atol=1e-14)


def test_the_residual_is_the_same_in_training_and_in_a_certificate():
    system = get_system("rossler")
    artifact = random_artifact("rossler", inputs=False, age=False, forward=True)
    linear, rng = artifact.filter, np.random.default_rng(0)
    x = rng.uniform(*system.box(), (50, 3))
    torch.manual_seed(0)
    problem = ForwardProblem(
        Network(3, linear.size, width=16, depth=2, activation="tanh"),
        system,
        linear=linear,
        pairs=(x, rng.normal(size=(50, linear.size))),
        points=x,
        scale=StateScale.of(x, "relative"),
        physics_weight=1.0,
        batch=64,
        device=torch.device("cpu"),
    )
    found, speed = problem.residual(torch.as_tensor(x, dtype=torch.float32))
    expected = residual_of(dataclasses.replace(artifact, forward=problem.forward_map()), system, x)
    np.testing.assert_allclose(found.detach(), expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(speed, np.linalg.norm(system.drift(x) / problem.scale.scale, axis=1), rtol=1e-5)


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_networks_come_back_from_numpy(activation):
    torch.manual_seed(0)
    network = Network(3, 2, width=8, depth=2, activation=activation)
    x = torch.randn(10, 3)
    again = from_mlp(network.export())
    assert not any(parameter.requires_grad for parameter in again.parameters())
    np.testing.assert_array_equal(again(x), network(x).detach())
    in_float64 = Smooth(network.export())(x.numpy())
    assert in_float64.dtype == float
    np.testing.assert_allclose(in_float64, network(x).detach(), atol=1e-5)
    scaled = ForwardMap(network.export(), np.ones(3), np.full(3, 2.0), np.full(2, 5.0), np.full(2, 3.0))
    np.testing.assert_allclose(
        encoder(scaled)(x.numpy()), 5.0 + 3.0 * network((x - 1.0) / 2.0).detach().numpy(), atol=1e-5
    )
