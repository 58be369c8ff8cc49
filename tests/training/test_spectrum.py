"""The eigenvalues of A, the filter with them, and the smoothness of T, measured by the z of neighbouring states."""

from dataclasses import dataclass

import numpy as np
import pytest
from linear_system import Oscillator, sylvester

from kkl_gym import get_system
from training.spectrum import SMOOTH, Spectrum, evenly_spaced, intervals, papers_spectrum, smooth_spectrum, smoothness
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
    np.testing.assert_allclose(data.z, data.x @ sylvester(linear.A, linear.B).T, atol=1e-4)  # holding y adds no error


@pytest.mark.parametrize(("ny", "nu"), [(1, 0), (2, 1)])
def test_each_output_has_a_filter_with_the_poles(ny, nu):
    spectrum = Spectrum((-2.0, -5.0), ((-0.9, 1.7),))
    linear = spectrum.filter(ny, 0.02, nu)
    assert (linear.dt, linear.nu) == (0.02, nu)
    block = np.zeros((4, 4))
    block[:2, :2], block[2:, 2:] = np.diag([-2.0, -5.0]), [[-0.9, 1.7], [-1.7, -0.9]]
    np.testing.assert_array_equal(linear.A, np.kron(np.eye(ny), block))
    np.testing.assert_array_equal(linear.B, np.kron(np.eye(ny), np.ones((4, 1))))
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(block)), np.sort_complex(spectrum.poles))


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

    assert Oscillator().typical_rate == pytest.approx(np.sqrt(2), rel=1e-6)
    with pytest.raises(ValueError, match=r"still\.rate\(x\) is 0\.0"):
        Still().typical_rate  # noqa: B018


def judged(system, *spectra, dt=0.05, **options):
    return list(smoothness(system, spectra, dt, **options))


def test_a_linear_map_is_smooth():
    slow, fast = judged(Oscillator(), Spectrum((-0.5, -1.0)), Spectrum((-2.0,), ((-1.5, 1.0),)))
    np.testing.assert_allclose(slow, np.ones(2), atol=0.05)
    np.testing.assert_allclose(fast, np.ones(3), atol=0.05)


def test_slow_modes_of_a_chaotic_system_are_rough():
    system = get_system("lorenz")
    papers, fast = judged(system, Spectrum(papers_spectrum(system)), Spectrum(evenly_spaced(7, -10.0, -40.0)), dt=0.01)
    assert papers.max() < 0.4
    assert (fast > SMOOTH).all()


def test_intervals_follow_the_rate_as_far_as_dt_resolves():
    system = Oscillator()
    found = intervals(system, 0.01)
    rate = system.typical_rate
    ends = np.array([(one.eigenvalues[0], one.eigenvalues[-1]) for one in found])
    assert ends[0, 0] == pytest.approx(-rate / 6, rel=1e-5)
    np.testing.assert_allclose(ends[:, 1] / ends[:, 0], 4.0, rtol=1e-5)
    np.testing.assert_allclose(ends[1:, 0] / ends[:-1, 0], np.sqrt(2.0), rtol=0.01)
    assert ends[-1, 0] == pytest.approx(-8 * rate, rel=1e-5)
    assert {len(one.poles) for one in found} == {5}
    coarse = intervals(system, 0.2)
    assert -0.5 / 0.2 * (1 + 1e-5) < coarse[-1].eigenvalues[-1] < coarse[0].eigenvalues[-1]
    (coarsest,) = intervals(system, 10.0)
    assert coarsest.eigenvalues[-1] == pytest.approx(-0.5 / 10.0, rel=1e-5)


def test_the_slowest_smooth_spectrum_is_chosen_and_always_the_same():
    system = Oscillator()
    found = smooth_spectrum(system, 0.05)
    assert found == intervals(system, 0.05)[0]
    smooth_spectrum.cache_clear()
    assert smooth_spectrum(Oscillator(), 0.05) == found


@dataclass(frozen=True)
class Resting(Oscillator):
    """All motions converge to a point at once."""

    name = "resting"

    def f(self, x):
        return -400.0 * (x[0] - 0.5), -500.0 * x[1]


@dataclass(frozen=True)
class Saddle(Oscillator):
    """All motions leave the bounds; transients of fast filters end earlier."""

    name = "saddle"
    bounds = ((-3, 3), (-3, 3))

    def f(self, x):
        return x[1], x[0]


@dataclass(frozen=True)
class Escaping(Oscillator):
    name = "escaping"

    def f(self, x):
        return 50.0 * x[0], 50.0 * x[1]


def test_motions_that_rest_or_leave():
    assert smooth_spectrum(Resting(), 0.01) == intervals(Resting(), 0.01)[-1]
    slow, fast = judged(Saddle(), intervals(Saddle(), 0.01)[0], intervals(Saddle(), 0.01)[-1])
    assert np.isnan(slow).all()
    assert (fast > SMOOTH).all()
    with pytest.raises(ValueError, match="motions of escaping leave"):
        smooth_spectrum(Escaping(), 0.01)
