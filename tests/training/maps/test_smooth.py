"""The differentiable forms of an artifact's maps, and the residual of the PDE."""

import dataclasses

import numpy as np
import pytest
from linear_system import C, F, Oscillator, exact_observer

import observers
from observers import MLP, ForwardMap
from training.maps.smooth import Smooth, decoder, encoder, residual


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_jacobians_by_differences(activation):
    rng = np.random.default_rng(1)
    network = Smooth(MLP([rng.normal(size=(7, 3)), rng.normal(size=(5, 7)), rng.normal(size=(2, 5))],
                         [rng.normal(size=7), rng.normal(size=5), rng.normal(size=2)], activation))  # fmt: skip
    x, eps = rng.normal(size=(4, 3)), 1e-6
    for j in range(3):
        step = eps * np.eye(3)[j]
        assert np.allclose(network.jacobian(x)[..., j], (network(x + step) - network(x - step)) / (2 * eps), atol=1e-7)


@pytest.mark.parametrize("name", ["van_der_pol-large", "rossler-spinn"])
def test_the_smooth_maps_are_the_observers(name):
    tracks = False if name.endswith("-large") else None
    observer = observers.load(name, 0.3, process_noise=0.03, tracking=tracks)
    y = np.random.default_rng(2).normal(size=(1, 1))
    observer.reset(y)
    for _ in range(6000):  # beyond the greatest age that the map tells apart
        x_hat = observer.step(y)
    assert np.allclose(decoder(observer.artifact, 0.3, 0.03)(observer.z), x_hat, atol=1e-4)
    if observer.artifact.forward is not None:
        x = np.random.default_rng(3).normal(size=(5, 3))
        assert np.allclose(encoder(observer.artifact.forward)(x), observer.artifact.forward(x), atol=1e-5)


def test_the_residual_is_that_of_the_equation():
    exact, M = exact_observer(), np.random.default_rng(4).normal(size=(3, 2))
    A, B = exact.filter.A, exact.filter.B
    scale, whiten = np.array([1.0, 1.0, 3.0]), np.array([2.0, 1.0])
    network = MLP([M.astype(np.float32)], [np.full(3, 0.2, np.float32)], "tanh")
    wrong = dataclasses.replace(exact, forward=ForwardMap(network, np.array([0.3, 0.0]), whiten, np.zeros(3), scale))
    x = np.random.default_rng(0).uniform(-1, 1, (10, 2))
    T = np.diag(scale) @ M @ np.diag(1 / whiten)
    offset = np.diag(scale) @ (0.2 - M @ [0.15, 0.0])
    expected = x @ (T @ F - A @ T - B @ C).T - A @ offset
    assert np.allclose(residual(wrong, Oscillator(), x), expected, atol=1e-5)
    with pytest.raises(ValueError, match="no forward map"):
        residual(dataclasses.replace(exact, forward=None), Oscillator(), x)
