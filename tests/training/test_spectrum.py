"""The eigenvalues of A and the filter that they make."""

import numpy as np
from linear_system import Oscillator, sylvester

from training.spectrum import Spectrum
from training.trajectories.record import record


def test_complex_modes_filter_a_linear_system_to_its_sylvester_solution():
    system = Oscillator()
    linear = Spectrum((-2.0,), ((-0.9, 1.7), (-1.5, 0.4))).filter(1, 0.01)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(linear.A)),
        np.sort_complex([-2.0, -0.9 + 1.7j, -0.9 - 1.7j, -1.5 + 0.4j, -1.5 - 0.4j]),
    )
    data = record(system, linear, n=20, steps=2500, ages=np.array([2400, 2500]), rng=np.random.default_rng(0))
    np.testing.assert_allclose(data.z, data.x @ sylvester(linear.A, linear.B).T, atol=1e-4)  # as holding y is exact
