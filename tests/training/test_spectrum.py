"""The eigenvalues of A and the filter that they make."""

import numpy as np
import pytest
from linear_system import Oscillator, sylvester

from kkl_gym import get_system
from training.spectrum import Spectrum, evenly_spaced, papers_spectrum
from training.trajectories.motions import Motions


def test_complex_modes_filter_a_linear_system_to_its_sylvester_solution():
    system = Oscillator()
    linear = Spectrum((-2.0,), ((-0.9, 1.7), (-1.5, 0.4))).filter(1, 0.01)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(linear.A)),
        np.sort_complex([-2.0, -0.9 + 1.7j, -0.9 - 1.7j, -1.5 + 0.4j, -1.5 - 0.4j]),
    )
    motions = Motions(system, linear.dt, 2500)
    data = motions.beside(linear, np.array([2400, 2500]), 20, np.random.default_rng(0))
    np.testing.assert_allclose(data.z, data.x @ sylvester(linear.A, linear.B).T, atol=1e-4)  # as holding y is exact


@pytest.mark.parametrize(("ny", "nu"), [(1, 0), (2, 1)])
def test_each_output_has_a_filter_with_the_poles(ny, nu):
    spectrum = Spectrum((-2.0, -5.0), ((-0.9, 1.7),))
    assert spectrum.modes == len(spectrum.poles) == 4
    linear = spectrum.filter(ny, 0.02, nu)
    assert (linear.dt, linear.nu) == (0.02, nu)
    block = np.zeros((4, 4))
    block[:2, :2], block[2:, 2:] = np.diag([-2.0, -5.0]), [[-0.9, 1.7], [-1.7, -0.9]]
    np.testing.assert_array_equal(linear.A, np.kron(np.eye(ny), block))
    np.testing.assert_array_equal(linear.B, np.kron(np.eye(ny), np.ones((4, 1))))
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(spectrum.A)), np.sort_complex(spectrum.poles))


def test_evenly_spaced_eigenvalues():
    found = evenly_spaced(5, -1.0, -16.0)
    assert all(isinstance(value, float) for value in found)
    np.testing.assert_allclose(found, [-1.0, -2.0, -4.0, -8.0, -16.0])
    assert papers_spectrum(get_system("van_der_pol")) == (-1.5, -1.875, -2.25, -2.625, -3.0)


def test_typical_rate():
    class Still(Oscillator):
        name = "still"

        def rate(self, x):
            return 0.0

    class Growing(Oscillator):
        name = "growing"

        def rate(self, x):
            return 3.0 + x[0]

    assert Oscillator().typical_rate == pytest.approx(np.sqrt(2), rel=1e-6)
    assert Growing().typical_rate == pytest.approx(3.0, abs=0.1)
    with pytest.raises(ValueError, match=r"still\.rate\(x\) is 0\.0"):
        Still().typical_rate  # noqa: B018
