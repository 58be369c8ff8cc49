"""What differentiating a system's equations gives."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from linear_system import Oscillator

from kkl_gym import get_system
from training.trajectories.derivatives import output_matrix


def test_output_matrix_of_linear_and_other_outputs():
    @dataclass(frozen=True)
    class Squared(Oscillator):
        name: ClassVar[str] = "squared"

        def h(self, x):
            return (x[0] * x[0],)

    np.testing.assert_array_equal(output_matrix(get_system("rossler")), [[0.0, 1.0, 0.0]])
    assert output_matrix(Squared()) is None
