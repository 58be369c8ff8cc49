"""Bounds of T_inv's Lipschitz constant, for networks with a known constant and for random networks."""

from itertools import pairwise

import linear_system
import numpy as np
import pytest
from commands import research
from linear_system import sylvester

from examples.research.lipschitz import decoder, lipschitz_lower, lipschitz_upper, norm_product
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from observers import MLP, load
from training.trajectories.motions import filter_states


def test_constants_that_are_known():
    assert lipschitz_upper(MLP([np.diag([3.0, 2.0])], [np.zeros(2)], "tanh")) == pytest.approx(3.0)
    # One neuron is steepest at zero, |w2| |w1|; layers with orthonormal rows are all steepest at the same point.
    neuron = MLP([np.array([[3.0, 4.0]]), np.array([[2.0]])], [np.zeros(1), np.zeros(1)], "tanh")
    assert lipschitz_upper(neuron) == pytest.approx(10.0, rel=1e-3)
    assert lipschitz_lower(neuron, np.zeros((1, 2))) == pytest.approx(10.0)
    turns = [np.linalg.qr(np.random.default_rng(i).normal(size=(6, 6)))[0] for i in range(3)]
    assert lipschitz_upper(MLP([turns[0], np.eye(6), turns[2]], [np.zeros(6)] * 3, "tanh")) == pytest.approx(1.0, 1e-3)
    silu = MLP([np.array([[3.0]]), np.array([[2.0]])], [np.zeros(1), np.zeros(1)], "silu")
    lower = lipschitz_lower(silu, np.array([[2.39935728052 / 3.0]]))  # where silu is steepest
    assert lower == pytest.approx(6.0 * 1.0998393201, rel=1e-9)
    assert lower <= lipschitz_upper(silu) <= norm_product(silu) < 1.000001 * lower


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_the_bound_holds_between_any_two_points(activation):
    rng, sizes = np.random.default_rng(0), (4, 20, 15, 3)
    weights = [rng.normal(size=(b, a)) for a, b in pairwise(sizes)]
    mlp = MLP(weights, [rng.normal(size=b) for b in sizes[1:]], activation)
    start = rng.normal(size=(300, 4))
    step = rng.normal(size=(300, 4)) * np.geomspace(1e-3, 1.0, 300)[:, None]
    slopes = np.linalg.norm(mlp(start + step) - mlp(start), axis=1) / np.linalg.norm(step, axis=1)
    upper = lipschitz_upper(mlp, 100)
    assert slopes.max() <= upper < norm_product(mlp)
    assert lipschitz_lower(mlp, start) <= upper


def test_the_decoder_is_the_observer_long_after_its_start():
    system, observer = get_system("van_der_pol"), load("van_der_pol-large", measurement_noise=0.5, tracking=False)
    x = simulate(system, np.array([[2.0, 0.0]]), 6000, 0.01)
    y, linear = system.output(x), observer.artifact.filter
    z = filter_states(linear, y, np.zeros((6000, 1, linear.nu)), np.array([6000]))[0]
    np.testing.assert_allclose(decoder(observer.artifact, 0.5)(z), observer.estimate(y)[-1], atol=0.01)


def test_the_command_on_an_own_map(tmp_path, capsys):
    artifact = linear_system.exact_observer(0.01)
    artifact.save(tmp_path / "mine.safetensors")
    research("lipschitz", str(tmp_path / "mine.safetensors"), "--system", f"{linear_system.__file__}:Oscillator")
    T = sylvester(artifact.filter.A, artifact.filter.B)
    assert f"{np.linalg.norm(np.linalg.pinv(T), 2):.3g}" in capsys.readouterr().out
