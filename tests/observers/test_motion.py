"""Motions: the order of the Runge-Kutta steps, discrete time, learned flows, and errors of motions that do not fit."""

from dataclasses import replace

import numpy as np
import pytest
from discrete_systems import Henon
from random_tracking import an_equation, tracking
from tracking import exact_equations, exact_flow, exact_motion, linear_motion

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from observers import ArtifactError, Equations, Expression

OSCILLATOR = Expression([["x", 1], ["+", ["*", -1, ["x", 0]], ["u", 0]]])
X, U = np.random.default_rng(0).normal(size=(5, 4, 2)), np.random.default_rng(1).normal(size=(4, 1))


def test_integration_is_of_order_four():
    dt, (Phi, Gamma) = 0.8, exact_motion(0.8)
    closed_form = X @ Phi.T + U @ Gamma.T
    errors = [np.abs(Equations(OSCILLATOR, n)(X, U, dt) - closed_form).max() for n in (2, 4, 8)]
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(4.0, abs=0.1)
    bent, fine = an_equation(3, 1, dt), Equations(an_equation(3, 1, dt).field, 256)
    x, u = X.reshape(-1, 8, 5)[..., :3], np.full(1, 0.7)
    errors = [np.abs(replace(bent, substeps=n)(x, u, dt) - fine(x, u, dt)).max() for n in (16, 32)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.3)


def test_equations_are_those_of_systems():
    system, mu, square = get_system("van_der_pol"), 3.0, ["**", ["x", 0], 2]
    field = [["x", 1], ["+", ["*", mu, ["+", 1, ["*", -1, square]], ["x", 1]], ["*", -1, ["x", 0]], ["u", 0]]]
    found = Equations(Expression(field), 8)(X[0], U, 0.01)
    np.testing.assert_allclose(found, simulate(system, X[0], 1, 0.01, U[None])[1], rtol=1e-7)
    field = [["+", 1, ["*", -1.4, square], ["x", 1], ["u", 0]], ["*", 0.3, ["x", 0]]]
    found = Equations(Expression(field), 0)(X[0] / 9, U / 99, 1.0)
    np.testing.assert_allclose(found, simulate(Henon(), X[0] / 9, 1, 1.0, U[None] / 99)[1], rtol=1e-14)


@pytest.mark.parametrize("by", ["equations", "flow"])
def test_flows_and_equations_of_a_linear_system_agree(by):
    (Phi, Gamma), motion = exact_motion(), linear_motion(by, nu=1)
    np.testing.assert_allclose(motion.step(X, U, 0.05), X @ Phi.T + U @ Gamma.T, rtol=1e-12, atol=1e-14)


def test_a_flow_is_an_affine_step_and_a_network():
    flow, s, v = tracking("flow", system="lorenz").motion.flow, np.array([0.3, -1.0, 0.5]), 0.7
    affine = s + flow.linear @ [1.0, *s, v]
    expected = affine + flow.gain * flow.mlp(np.array([*s, v]))
    np.testing.assert_allclose(flow(s, v * flow.u_scale), expected, rtol=1e-12)
    assert np.abs(expected - affine).max() > 1e-3


def test_variances_have_floors():
    motion = replace(linear_motion(ny=2), error=np.array([0.1, 0.0]))
    for level, assumed in ((0.0, 1.0), (3.0, 3.0)):
        Q, R = motion.variances((0.0, 0.3), level)
        np.testing.assert_allclose(Q, (assumed * motion.process_noise) ** 2 + motion.error**2)
        np.testing.assert_allclose(R, [0.01**2, 0.3**2])


@pytest.mark.parametrize(("changes", "words"), [
    ({"flow": exact_flow()}, "either equations or a flow"),
    ({"equations": None}, "either equations or a flow"),
    ({"equations": None, "flow": tracking("flow", system="lorenz").motion.flow}, "a Motion of 2 states does not fit"),
    ({"equations": Equations(Expression([["x", 0], ["x", 2]]))}, "a Motion of 2 states does not fit"),
    *(({name: np.zeros(3)}, name) for name in ("x_scale", "low", "high", "mean", "error", "process_noise")),
    *(({name: np.zeros(size)}, f"{name} of a Motion must be positive, got")
      for name, size in (("x_scale", 2), ("least_measurement_noise", 1))),
    *(({name: -np.ones(2)}, f"{name} of a Motion must not be negative") for name in ("error", "process_noise")),
    *(({"covariance": np.array(wrong)}, "a covariance must be positive definite, got")
      for wrong in ([[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]])),
    ({"low": np.full(2, 50.0)}, "bounds of a Motion must go from low to high"),
    *(({name: wrong}, f"{name} of a Motion must be positive and at most")
      for name in ("least_process_noise", "window") for wrong in (0.0, np.nan, 1e200, "1", None, True)),
])  # fmt: skip
def test_motions_that_do_not_fit(changes, words):
    with pytest.raises(ArtifactError, match=words):
        replace(linear_motion(), **changes)


def test_covariances_may_be_in_any_units():
    units = np.array([1e-12, 1e12])
    covariance = linear_motion().covariance * np.outer(units, units)
    assert replace(linear_motion(), covariance=covariance).covariance is covariance


def test_steps_that_do_not_fit():
    for wrong in (-1, 1025, 1.0, True, None):
        with pytest.raises(ArtifactError, match=f"substeps must be an integer from 0 to 1024, got {wrong}"):
            replace(exact_equations(), substeps=wrong)
    for name, wrong in (("linear", np.zeros((2, 3))), ("gain", np.ones(3)), ("u_scale", np.zeros(1))):
        with pytest.raises(ArtifactError, match=r"flow|shape|fit"):
            replace(exact_flow(nu=1), **{name: wrong})
