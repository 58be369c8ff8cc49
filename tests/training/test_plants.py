"""The cart pole and the pendulum on a circle in examples/ against those of Gymnasium."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import kkl_gym
from kkl_gym.simulate import simulate
from observers.estimator import Running
from training.evaluation.errors import starts
from training.kalman import ExtendedKalmanFilter, unknown_start

EXAMPLES = Path(__file__).parents[2] / "examples"
CART_POLE = f"{EXAMPLES / 'cart_pole.py'}:CartPole"
PENDULUM = f"{EXAMPLES / 'circle_pendulum.py'}:CirclePendulum"


@pytest.fixture
def pendulum():
    return kkl_gym.get_system(PENDULUM)


def derivative(system, x, u):
    """f + g u at a single state."""
    return [fi + row[0] * u for fi, row in zip(system.f(x), system.g(x), strict=True)]


def test_cart_pole_is_gymnasiums():
    system, env = kkl_gym.get_system(CART_POLE), gym.make("CartPole-v1").unwrapped
    assert system.u_max == (env.force_mag,)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for action in (0, 1) * 10:
        x = rng.uniform([-2, -2, -0.2, -2], [2, 2, 0.2, 2])
        env.state = tuple(x)  # Gymnasium's cart pole takes Euler steps
        env.steps_beyond_terminated = None
        env.step(action)
        slope = (np.array(env.state) - x) / env.tau
        np.testing.assert_allclose(derivative(system, x, (2 * action - 1) * env.force_mag), slope, rtol=1e-9, atol=1e-9)


def test_the_circle_pendulum_is_gymnasiums(pendulum):
    env = gym.make("Pendulum-v1").unwrapped
    assert pendulum.u_max == (env.max_torque,)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        angle, rate, torque = rng.uniform([-np.pi, -4, -2], [np.pi, 4, 2])
        env.state = np.array([angle, rate])
        env.step(np.array([torque]))
        x = np.cos(angle), np.sin(angle), rate
        cosine, sine, acceleration = derivative(pendulum, x, torque)
        assert acceleration == pytest.approx((env.state[1] - rate) / env.dt)
        assert (cosine, sine) == pytest.approx((-rate * np.sin(angle), rate * np.cos(angle)))


def test_starts_beyond_x_are_on_the_circle_too(pendulum):
    x = starts(pendulum, "2X", 100, np.random.default_rng(0))
    np.testing.assert_allclose(np.hypot(x[:, 0], x[:, 1]), 1.0)
    assert (np.abs(x[:, 2]) > 8).all()


def test_mean_and_covariance_of_unknown_starts_on_the_circle(pendulum):
    mean, covariance = unknown_start(pendulum)
    np.testing.assert_allclose(mean, 0.0, atol=0.2)
    np.testing.assert_allclose(covariance, np.diag([0.5, 0.5, 64 / 3]), atol=0.5)
    x = simulate(pendulum, pendulum.draw_starts(np.random.default_rng(1), 5), 300, pendulum.dt)
    y = pendulum.output(x) + 0.05 * np.random.default_rng(2).normal(size=(301, 5, 2))
    kalman = ExtendedKalmanFilter(pendulum, pendulum.dt, Q=1e-6 * np.eye(3), R=0.05**2 * np.eye(2))
    x_hat = Running(kalman).along(y)
    assert np.sqrt(np.square(x_hat - x)[150:].mean((0, 1))) == pytest.approx(0, abs=0.2)
