"""What Kalman filters are told as methods of the benchmark."""

import numpy as np
import pytest

from examples.research.methods import get_method
from examples.research.methods.kalman import DIFFUSION, WRONG_DIFFUSION, diffusion_intensity
from kkl_gym import get_system
from training.kalman import IteratedKalmanFilter, measurement_covariance


def test_wrong_models_are_ten_percent_off():
    believed = get_method("ekf-wrong").believed(get_system("lorenz"))
    assert believed.parameters == pytest.approx({"sigma": 11.0, "rho": 30.8, "beta": 8.8 / 3})
    duffing = get_system("reverse_duffing")
    assert get_method("ekf-wrong").believed(duffing).parameters == {"a": 1.1, "b": 1.1}


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_kalman_filters_are_told_the_noise(name):
    method, system = get_method(name), get_system("van_der_pol")
    y0 = np.array([[3.0]])
    moved = [
        method.observer({"diffusion": np.array([0.01])}, system, 0.01, noise).reset(y0)[0, 0] for noise in (0.0, 50.0)
    ]
    assert moved[0] == pytest.approx(3.0, abs=0.01)  # from the centre of X, 0
    assert moved[1] == pytest.approx(3.0 * (25 / 3) / (25 / 3 + 2500), rel=1e-6)


@pytest.mark.parametrize(("name", "levels"), [("ekf", DIFFUSION), ("ukf", DIFFUSION), ("ekf-wrong", WRONG_DIFFUSION)])
def test_diffusion_is_in_multiples_of_the_scale_per_root_of_a_second(name, levels):
    """Where nothing is measured it adds its square times dt to the variance of each state."""
    method, system, dt = get_method(name), get_system("lorenz"), 1e-4
    assert [one["diffusion"] for one in method.configurations(system)] == list(levels)
    variance = []
    for level in (0.0, 0.1):
        observer = method.observer({"diffusion": np.array([level])}, system, dt, 1e9)
        observer.reset(np.zeros((1, 1)))
        observer.step(np.zeros((1, 1)))
        variance.append(np.diag(observer.P[0]))
    np.testing.assert_allclose(variance[1] - variance[0], (0.1 * np.array(system.scale)) ** 2 * dt, rtol=1e-6)


def test_the_guided_filter_takes_the_shipped_map_and_is_told_the_noise():
    method, system = get_method("guided"), get_system("van_der_pol")
    assert [one["diffusion"] for one in method.configurations(system)] == list(DIFFUSION)
    y = np.array([[3.0], [-1.0]])
    for noise in (1.0, 50.0):  # which is beyond what the map was trained for
        ours = method.observer({"diffusion": np.array([0.01])}, system, 0.01, noise)
        Q = diffusion_intensity({"diffusion": np.array([0.01])}, system)
        alone = IteratedKalmanFilter(system, 0.01, Q=Q, R=measurement_covariance(system, noise))
        np.testing.assert_allclose(ours.reset(y), alone.reset(y), rtol=1e-12)
        np.testing.assert_allclose(ours.step(y), alone.step(y), rtol=1e-12)
    with pytest.raises(ValueError, match=r"sampling interval dt = 0\.01"):
        method.observer({"diffusion": np.array([0.01])}, system, 0.02, 0.0)


def test_the_ukf_takes_every_trajectory_of_the_benchmark():
    assert getattr(get_method("ukf"), "trajectories", None) is None
