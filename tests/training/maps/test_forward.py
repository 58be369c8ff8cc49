"""The forward map T and its equation, against finite differences and quadrature."""

import re

import numpy as np
import pytest
import torch
from kinked_systems import SYSTEMS as KINKED
from linear_system import Autonomous, sylvester
from quadrature import backward_quadrature
from small_runs import CPU, toy
from wrong_systems import Branching, Late

from examples.research.derivatives import evaluate, jacobian
from kkl_gym import EquationError, ReverseDuffing, get_system
from kkl_gym.simulate import simulate
from kkl_gym.system import on_states
from observers import Artifact, LinearFilter
from observers.names import resolve
from training.maps.forward import ForwardProblem, along, on_tensors, transients, truncation_step
from training.maps.networks import Network, from_mlp
from training.spectrum import Spectrum
from training.trajectories.motions import filter_states


def test_truncation_leaves_epsilon_of_any_start():
    system = Autonomous()
    linear = LinearFilter(np.array([[-1.0, 5.0], [0.0, -2.0]]), np.ones((2, 1)), 0.01)
    k = truncation_step(system, linear, steps=5000, epsilon=1e-6, box_factor=2.0)
    z0 = linear.start(np.array([[-2.0], [2.0]]))
    left = np.linalg.norm(np.linalg.matrix_power(linear.transition, k) @ z0.T, axis=0)
    assert (left <= 1e-6).all()
    assert k < 2500
    with pytest.raises(ValueError, match="make them longer"):
        truncation_step(system, linear, steps=100, epsilon=1e-6, box_factor=2.0)


def test_shipped_forward_map_of_reverse_duffing_against_backward_quadrature():
    artifact, system = Artifact.read(resolve("reverse_duffing-spinn")), ReverseDuffing()
    x = np.random.default_rng(0).uniform(*system.box(2.0), (12, 2))
    truth = np.array([backward_quadrature(point, artifact.filter.A.diagonal()) for point in x])
    error = artifact.forward(x) - truth
    assert np.sqrt((error**2).mean()) < 1e-3 * np.sqrt((truth**2).mean())


def problem_of_the_oscillator(unit=1.0):
    """An untrained T of the linear oscillator, with exact pairs."""
    system, linear = Autonomous(), Spectrum((-1.0,), ((-0.5, 2.0),)).filter(1, 0.01)
    x = unit * np.random.default_rng(0).uniform(-1, 1, (3000, 2))
    exact = sylvester(linear.A, linear.B)
    torch.manual_seed(0)
    config = toy(system, "spinn", width=40, batch=256)
    return ForwardProblem(system, linear, config, pairs=(x, x @ exact.T), points=x, device=CPU), exact


def test_the_risk_compiles_to_one_graph():
    problem, _ = problem_of_the_oscillator()
    expected = problem.loss(torch.Generator().manual_seed(2))["loss"]
    problem._risk = torch.compile(problem.risk, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(problem.loss(torch.Generator().manual_seed(2))["loss"], expected)


@pytest.mark.parametrize("unit", [1.0, 1e-14])
def test_solved_output_layer_minimises_the_risk_over_it(unit):
    problem, exact = problem_of_the_oscillator(unit)
    problem.solve_output_layer(np.random.default_rng(0))
    x = unit * np.random.default_rng(1).uniform(-1, 1, (500, 2))
    expected = x @ exact.T
    assert np.abs(problem.forward_map()(x) - expected).max() < 2e-3 * np.abs(expected).max()

    def risk():
        return problem.loss(torch.Generator().manual_seed(1))["loss"].item()

    least, last = risk(), problem.network.linear_layers()[-1]
    for _ in range(3):
        with torch.no_grad():
            step = 3e-3 * torch.randn(last.weight.shape)
            last.weight += step
            assert risk() > least
            last.weight -= step


def test_filter_state_is_T_plus_the_transient_of_the_start():
    system, linear = Autonomous(), Spectrum((-1.0,), ((-0.5, 2.0),)).filter(1, 0.001)
    ages = np.array([0, 1, 100, 1000])
    x = simulate(system, np.random.default_rng(0).uniform(-1, 1, (5, 2)), 1000, 0.001)
    simulated = filter_states(linear, system.output(x), np.zeros((1000, 5, 0)), ages)
    T = x[ages] @ sylvester(linear.A, linear.B).T
    found = transients(T, simulated[0], linear=linear, ages=ages)
    assert np.abs(T[1] - simulated[1]).max() > 0.1  # the transient is large
    np.testing.assert_allclose(found, simulated, atol=1e-6)


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
        (Late().f, "; x held tensors of shape (4,): use kkl_gym.elementary.sin, which takes"),
        (Branching().f, "; x held tensors of shape (4,), on which `if`, `and`, `or` and `not` cannot decide: use"),
        (
            lambda x: (x[0], x[1].reshape(2, 2)),
            "whose entry [1] is an array of shape (2, 2), where components of x have shape",
        ),
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


def test_the_residual_is_that_of_the_equation():
    problem, _ = problem_of_the_oscillator()
    x, T, linear = np.random.default_rng(2).uniform(-1, 1, (10, 2)), problem.forward_map(), problem.linear
    f, y = problem.system.drift(x), problem.system.output(x)
    expected = (T(x + 1e-3 * f) - T(x - 1e-3 * f)) / 2e-3 - T(x) @ linear.A.T - y @ linear.B.T
    residual, speed = problem.residual(torch.tensor(x, dtype=torch.float32))
    np.testing.assert_allclose(residual.detach(), expected, atol=2e-3)
    np.testing.assert_allclose(speed.detach(), np.linalg.norm(f / problem.scale.scale, axis=1), rtol=1e-5)


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_networks_come_back_from_numpy(activation):
    network, x = Network(3, 2, width=8, depth=2, activation=activation), torch.randn(10, 3)
    again = from_mlp(network.export())
    assert not any(parameter.requires_grad for parameter in again.parameters())
    np.testing.assert_array_equal(again(x), network(x).detach())
