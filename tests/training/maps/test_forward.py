"""The forward map T and its equation, against finite differences and quadrature."""

import numpy as np
import pytest
import torch
from linear_system import Autonomous, sylvester
from quadrature import backward_quadrature
from small_runs import CPU

from kkl_gym import ReverseDuffing
from kkl_gym.simulate import simulate
from observers import Artifact, LinearFilter
from observers.names import resolve
from training.maps.forward import ForwardProblem, transients, truncation_time
from training.maps.networks import Network
from training.maps.scaling import StateScale
from training.spectrum import Spectrum


def test_truncation_time_leaves_epsilon():
    A = np.array([[-1.0, 5.0], [0.0, -2.0]])
    linear = LinearFilter(A, np.ones((2, 1)), 0.01)
    t = truncation_time(linear, 10.0, 1e-6)
    poles, V = np.linalg.eig(A)
    left = np.linalg.norm((V * np.exp(poles * t)) @ np.linalg.inv(V), 2) * 10.0
    assert left <= 1e-6
    assert t == pytest.approx(np.log(np.linalg.cond(V) * 10.0 / 1e-6))


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
    problem = ForwardProblem(
        Network(2, 3, width=40, depth=2, activation="tanh"),
        system,
        linear=linear,
        pairs=(x, x @ exact.T),
        points=x,
        scale=StateScale.of(x, "relative"),
        physics_weight=0.1,
        batch=256,
        device=CPU,
    )
    return problem, exact


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


def test_filter_state_from_T_and_what_is_left_of_its_start():
    system, linear = Autonomous(), Spectrum((-1.0,), ((-0.5, 2.0),)).filter(1, 0.001)
    ages = np.array([0, 1, 100, 1000])
    x = simulate(system, np.random.default_rng(0).uniform(-1, 1, (5, 2)), 1000, 0.001)
    simulated = linear.run(system.output(x), np.zeros((1000, 5, 0)), ages)
    T = x[ages] @ sylvester(linear.A, linear.B).T
    found = transients(T, simulated[0], linear=linear, ages=ages)
    assert np.abs(T[1] - simulated[1]).max() > 0.1  # the start is far from T
    np.testing.assert_allclose(found, simulated, atol=1e-6)
