"""Outputs of systems as expressions with the same values."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import sympy
from linear_system import Oscillator

from kkl_gym import System, get_system
from kkl_gym.elementary import abs as absolute
from kkl_gym.elementary import atan2, clip, cos, exp, log, maximum, minimum, sign, sin, sqrt, tan, tanh, where
from training.trajectories.equations import field_expression, output_expression, output_matrix


@dataclass(frozen=True)
class Everything(System):
    """A system whose output uses every elementary function."""

    length: float = 1.5

    name: ClassVar[str] = "everything"
    X: ClassVar = ((-2, 2), (-1, 3))
    bounds: ClassVar = ((-9, 9), (-9, 9))

    def f(self, x):
        return x[1], -x[0]

    def h(self, x):
        a, b = x
        return (
            self.length * sin(a) - cos(b) / 3 + 7,
            tan(a / 2) + tanh(b) + exp(-b),
            log(1 + a**2) * sqrt(absolute(b)) - sign(a),
            atan2(b, a) + minimum(a, b) * maximum(a, 0.5) + clip(a, -1, 1),
            where(a > 0, a, where((b <= 1) & (a < -1), b, 2.0)) + where((a >= 1) | (b > 2), 1.0, 0.0),
            (a**2 + b**2) ** -0.5 + b**3 + a % 1.5,
            absolute(self.length - a),
            4.0,
        )


def test_every_function_is_written_down():
    found = output_expression(Everything())
    x = np.random.default_rng(1).uniform(-3, 3, (500, 2))
    np.testing.assert_allclose(found(x), Everything().output(x), rtol=1e-12, atol=1e-12)
    other = Everything(length=0.5)
    np.testing.assert_allclose(output_expression(other)(x), other.output(x), rtol=1e-12, atol=1e-12)


def deep(x, levels=30):
    return sin(deep(x, levels - 1)) if levels else x[0]


@pytest.mark.parametrize(
    ("h", "match"),
    [
        (lambda self, x: (math.sin(x[0]),), r"test_output_expression\.py, line \d+.* kkl_gym\.elementary"),
        (lambda self, x: (x[0] if x[0] > 0 else x[1],), r"kkl_gym\.elementary\.where"),
        (lambda self, x: (sympy.sinh(x[0]) if isinstance(x[0], sympy.Basic) else np.sinh(x[0]),), "'sinh' must be"),
        (lambda self, x: (1e-13 * (1 + isinstance(x[0], sympy.Basic)) * x[0],), "symbols and arrays differ"),
        (lambda self, x: (deep(x),), "24 nested functions"),
    ],
)
def test_outputs_that_cannot_be_written_down(h, match):
    kind = type("Odd", (Oscillator,), {"name": "odd", "h": h})
    with pytest.raises(ValueError, match=rf"(?s)observer of 'odd' cannot hold h\(x\).*{match}"):
        output_expression(kind())


def test_a_message_about_inputs_does_not_blame_f_alone():
    def g(self, x):
        return [[math.sin(x[0])], [1.0]]

    pushed = type("Pushed", (Oscillator,), {"name": "pushed", "u_max": (1.0,), "g": g})
    with pytest.raises(ValueError, match=r"cannot hold f\(x\) \+ g\(x\) u as an expression: g\(x\) of 'pushed' failed"):
        field_expression(pushed())


def test_output_matrix_of_linear_and_other_outputs():
    np.testing.assert_array_equal(output_matrix(get_system("rossler")), [[0.0, 1.0, 0.0]])
    for h, X in (
        (lambda self, x: (x[0] * x[0],), ((-1, 1), (-1, 1))),
        (lambda self, x: (x[0] * x[0],), ((-1e-13, 1e-13), (-1e-13, 1e-13))),
        (lambda self, x: (x[0] / x[1],), ((1, 2), (1, 2))),
    ):
        assert output_matrix(type("Odd", (Oscillator,), {"name": "odd", "h": h, "X": X})()) is None
