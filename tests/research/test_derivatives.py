"""Derivatives of a system's equations."""

import numpy as np
import pytest
import sympy
from kinked_systems import SYSTEMS as KINKED

from examples.research.derivatives import evaluate, jacobian
from kkl_gym import elementary
from kkl_gym.system import on_states


@pytest.mark.parametrize("system", KINKED, ids=str)
def test_derivatives_of_kinked_equations(system):
    x, eps = np.random.default_rng(0).uniform(*system.box(2), (200, system.nx)), 1e-7
    for equations in (system.f, system.h):
        exact = evaluate(jacobian(equations, system.nx), x)
        for j in range(system.nx):
            step = eps * np.eye(system.nx)[j]
            difference = (on_states(equations, x + step) - on_states(equations, x - step)) / (2 * eps)
            np.testing.assert_allclose(exact[..., j], difference, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("equation", "at", "slope"),
    [
        (lambda x: abs(x), [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]),
        (lambda x: elementary.sign(elementary.sqrt(x) - 1.0) * x, [0.25, 4.0], [-1.0, 1.0]),
        (lambda x: elementary.maximum(x, 1.0), [0.0, 1.0, 2.0], [0.0, 0.5, 1.0]),
        (lambda x: elementary.maximum(elementary.minimum(x, 2.0), 2.0 * x - 3.0), [1.0, 2.25, 3.0], [1.0, 0.0, 2.0]),
        (lambda x: elementary.where(x > 0, elementary.log(x), -x), [-1.0, 2.0], [-1.0, 0.5]),
        (lambda x: elementary.where(abs(x) > 1.0, x * x, 0.0), [-2.0, 0.5, 2.0], [-4.0, 0.0, 4.0]),
        (lambda x: x * (x // 1.0), [1.5, 2.5], [1.0, 2.0]),
        (lambda x: 1.0, [1.5, 2.5], [0.0, 0.0]),
    ],
)  # fmt: skip
def test_derivatives_at_kinks_and_jumps(equation, at, slope):
    found = evaluate(jacobian(lambda x: (equation(x[0]),), 1), np.array(at)[:, None])
    np.testing.assert_allclose(found[:, 0, 0], slope, rtol=1e-14)
    for one, expected in zip(at, slope, strict=True):  # single states
        assert evaluate(jacobian(lambda x: (equation(x[0]),), 1), np.array([one]))[0, 0] == pytest.approx(expected)


def test_functions_that_sympy_cannot_differentiate_are_named():
    def rounded(x):
        return x[0], sympy.ceiling(x[0])

    with pytest.raises(ValueError, match=r"component 1 of rounded\(x\) has no derivative in sympy: ceiling\(x0\)"):
        jacobian(rounded, 1)
