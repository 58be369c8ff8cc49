"""The least error of any observer, against closed forms for linear systems and Riccati's recursion for Lorenz."""

import numpy as np
import pytest
from linear_system import F, Oscillator
from scipy.linalg import expm

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from training.diagnosis.outputs import FOLLOWED, least_errors
from training.diagnosis.system import Subject
from training.kalman import unknown_start

START = unknown_start(Oscillator())[1]


def made(**changes):
    """The oscillator with other attributes."""
    return type("Made", (Oscillator,), {"name": "made", **changes})()


def of(system, *noise, duration=6.0, **options):
    return least_errors(Subject(system, 0.01, duration, noise=noise, **options))


@pytest.fixture(scope="module")
def oscillator():
    return of(Oscillator(), 0.3)


def test_chaotic_motions_are_followed_as_by_riccatis_recursion():
    system = get_system("lorenz")
    subject = Subject(system, 0.02, 20.0, noise=(0.5,))
    found, (x, u) = least_errors(subject)[0][1], (each[:, :FOLLOWED] for each in subject.followed)
    n, before = x.shape[1], x[:-1].reshape(-1, 3)
    held = u.reshape(1, -1, 1)
    ends = [simulate(system, before + side * row, 1, 0.02, u=held)[1] for row in np.eye(3) for side in (1e-4, -1e-4)]
    steps = np.stack([(ends[2 * j] - ends[2 * j + 1]) / 2e-4 for j in range(3)], -1).reshape(-1, n, 3, 3)
    P, H, left = np.broadcast_to(unknown_start(system)[1], (n, 3, 3)), np.array([[0.0, 1.0, 0.0]]), []
    for step in (np.broadcast_to(np.eye(3), (n, 3, 3)), *steps):
        P = step @ P @ step.mT
        P = (np.eye(3) - P @ H.T / (H @ P @ H.T + 0.25) @ H) @ P
        left.append(np.diagonal(P, axis1=1, axis2=2))
    expected = np.sqrt(np.array(left).mean(1)) / x.std((0, 1))
    np.testing.assert_allclose(found, expected, rtol=1e-2)


def test_outputs_have_their_own_noise_and_constant_outputs_have_no_information():
    both, one, still = (
        of(made(h=h), level)[0]
        for h, level in (
            (lambda self, x: x, (0.3, 1e6)),
            (lambda self, x: x[:1], 0.3),
            (lambda self, x: (0.0 * x[0],), 0.3),
        )
    )
    np.testing.assert_allclose(both[1], one[1], rtol=1e-5)
    assert (both[0].mean(0) <= one[0].mean(0)).all()
    carried = [expm(k * 0.01 * F) @ START @ expm(k * 0.01 * F).T for k in range(len(still[1]))]
    size = np.sqrt(np.diagonal(carried, axis1=1, axis2=2))
    np.testing.assert_allclose(still[1] / still[1, 0], size / size[0], rtol=1e-4)


def test_least_errors_do_not_depend_on_the_units_of_states(oscillator):
    """The oscillator with x2 in other units, around another point."""
    other = made(
        X=((4.0, 6.0), (6000.0, 8000.0)),
        bounds=((-25.0, 35.0), (-23000.0, 37000.0)),
        G=((0.0,), (1000.0,)),
        f=lambda self, x: (1e-3 * x[1] - 7.0, -1e3 * (x[0] - 5.0)),
    )
    for found, expected in zip(of(other, 0.3), oscillator):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)


def test_motions_that_leave_or_are_short():
    with pytest.raises(ValueError, match=r"only 0 motions from X stayed within the bounds; .* \(--policy\)"):
        of(made(f=lambda self, x: (x[1], 4.0 * x[0])))
    with pytest.raises(ValueError, match=r"motions of 0.05 s have only 5 steps of 0.01 s"):
        of(Oscillator(), duration=0.05)
