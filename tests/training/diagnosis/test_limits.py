"""The least error of any observer, against closed forms on linear systems and a Kalman filter on Lorenz's."""

import numpy as np
import pytest
from linear_system import F, Oscillator
from scipy.linalg import expm

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from training.diagnosis.limits import Limits
from training.diagnosis.subject import Subject
from training.kalman import ExtendedKalmanFilter, unknown_start

START = unknown_start(Oscillator())[1]


def made(**changes):
    """The oscillator with other attributes."""
    return type("Made", (Oscillator,), {"name": "made", **changes})()


@pytest.fixture(scope="module")
def limits():
    return Limits.of(Subject(Oscillator(), 0.01, 6.0))


def test_errors_are_those_of_a_kalman_filter(limits):
    kalman = ExtendedKalmanFilter(
        Oscillator(), 0.01, Q=np.zeros((2, 2)), R=0.09 * np.eye(1), start=(np.zeros(2), START)
    )
    y = Oscillator().output(limits.x)
    state, P = kalman.start(y.shape[1]), []
    for sample in y:
        state = kalman.advance(state, sample)
        P.append(state.P[0])
    P = np.array(P)[limits.ages]
    of_states = np.sqrt(np.diagonal(P, axis1=1, axis2=2)) / limits.x.std((0, 1))
    np.testing.assert_allclose(limits.errors(0.3), of_states, rtol=1e-6)
    back = expm(-0.01 * limits.ages[-1] * F)
    unknown = back @ P[-1] @ back.T / np.sqrt(np.outer(*2 * [np.diag(START)]))  # in the start's standard deviations
    np.testing.assert_allclose(limits.unknown_of_starts(0.3), unknown, rtol=1e-5, atol=1e-9)


def test_chaotic_motions_are_followed_as_far_as_numbers_go():
    """The recursion of Riccati, which forgets what is lost, against the sum over all samples."""
    system = get_system("lorenz")
    limits = Limits.of(Subject(system, 0.02, 20.0))
    assert 1e4 < np.abs(limits.Phi).max() < 1e5
    assert len(limits.x) < 900
    assert limits.weights[limits.ages < limits.ages[-1] / 2].sum() < 0.3  # what comes later is like the second half
    n, before = limits.x.shape[1], limits.x[:-1].reshape(-1, 3)
    ends = [simulate(system, before + side * row, 1, 0.02)[1] for row in np.eye(3) for side in (1e-4, -1e-4)]
    steps = np.stack([(ends[2 * j] - ends[2 * j + 1]) / 2e-4 for j in range(3)], -1).reshape(-1, n, 3, 3)
    P, H, left = np.broadcast_to(unknown_start(system)[1], (n, 3, 3)), np.array([[0.0, 1.0, 0.0]]), []
    for step in (np.broadcast_to(np.eye(3), (n, 3, 3)), *steps):
        P = step @ P @ step.mT
        P = (np.eye(3) - P @ H.T / (H @ P @ H.T + 0.25) @ H) @ P
        left.append(np.diagonal(P, axis1=1, axis2=2))
    expected = np.sqrt(np.array(left)[limits.ages].mean(1)) / limits.x.std((0, 1))
    np.testing.assert_allclose(limits.errors(0.5), expected, rtol=1e-3)


def test_outputs_have_noise_of_their_own_and_one_that_does_not_move_says_nothing():
    both, one, still = (
        Limits.of(Subject(made(h=h), 0.01, 6.0))
        for h in (lambda self, x: x, lambda self, x: x[:1], lambda self, x: (0.0 * x[0],))
    )
    np.testing.assert_allclose(both.errors((0.3, 1e6)), one.errors(0.3), rtol=1e-6)
    assert (both.weights @ both.errors(0.3) < one.weights @ one.errors(0.3)).all()
    carried = [expm(age * 0.01 * F) @ START @ expm(age * 0.01 * F).T for age in still.ages]
    expected = np.sqrt(np.diagonal(carried, axis1=1, axis2=2)) / still.x.std((0, 1))
    np.testing.assert_allclose(still.errors(0.3), expected, rtol=1e-4)


def test_a_policy_does_not_change_how_well_a_linear_system_is_known(limits):
    """It chooses the inputs, which the observer knows."""
    driven = Limits.of(Subject(Oscillator(), 0.01, 6.0, policy=lambda x: np.tanh(x[:, :1])))
    assert np.abs(driven.x[-1] - limits.x[-1]).max() > 0.01
    np.testing.assert_allclose(driven.Phi, limits.Phi, rtol=1e-6, atol=1e-8)


def test_limits_do_not_depend_on_the_units_of_states(limits):
    """The oscillator with x2 in thousandths, about another point."""
    other = made(
        X=((4.0, 6.0), (6000.0, 8000.0)),
        bounds=((-25.0, 35.0), (-23000.0, 37000.0)),
        f=lambda self, x: (1e-3 * x[1] - 7.0, -1e3 * (x[0] - 5.0)),
    )
    np.testing.assert_allclose(Limits.of(Subject(other, 0.01, 6.0)).errors(0.3), limits.errors(0.3), rtol=1e-5)


def test_equations_that_are_for_numbers_alone_have_limits_too(limits):
    of_numpy = made(f=lambda self, x: (x[1], -np.arcsinh(np.sinh(x[0]))))
    np.testing.assert_allclose(Limits.of(Subject(of_numpy, 0.01, 6.0)).errors(0.3), limits.errors(0.3), rtol=1e-4)


def test_motions_that_leave_or_are_short():
    with pytest.raises(ValueError, match=r"only 0 motions from X stayed within the bounds; .* \(--policy\)"):
        Limits.of(Subject(made(f=lambda self, x: (x[1], 4.0 * x[0])), 0.05, 6.0))
    with pytest.raises(ValueError, match=r"only 5 samples of 0.01 s can be followed"):
        Limits.of(Subject(Oscillator(), 0.01, 0.05))
