"""Flows that are late, on a rotation, of which everything is known."""

import dataclasses

import numpy as np
import pytest
import torch
from linear_system import Oscillator
from tracking import DT, exact_flow, exact_motion, tracking_observer

from kkl_gym.simulate import SubstepsError
from training.maps import ahead
from training.maps.ahead import AheadProblem, draw_courses, learn_ahead
from training.progress import progress_bars


@pytest.fixture(scope="module", autouse=True)
def short():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ahead, "SAMPLES", 20)
        patch.setattr(ahead, "JUDGED", 100)
        yield


@pytest.fixture(scope="module")
def exact():
    return tracking_observer().flow


@pytest.fixture(scope="module")
def courses():
    return draw_courses(Oscillator(), np.random.default_rng(0).uniform(-1, 1, (500, 2)), np.zeros((500, 0)), DT)


def late(flow, share):
    """The same motion, by so much of a sample behind."""
    return dataclasses.replace(flow, polynomial=(1 - share) * flow.polynomial, gain=np.full(2, 1e-2))


def judged(flow, courses):
    return AheadProblem(flow, courses, device=torch.device("cpu")).judged()


def learned(flow, courses, steps=300):
    with progress_bars(None) as progress:
        return learn_ahead(flow, courses, steps=steps, seed=0, progress=progress)


def test_courses_are_motions_of_the_system(courses):
    Phi, _ = exact_motion()
    assert courses.x.shape == (21, 500, 2)
    np.testing.assert_allclose(courses.x[-1], courses.x[0] @ np.linalg.matrix_power(Phi, 20).T, atol=1e-6)


def test_a_flow_that_is_late_is_mended(exact, courses):
    flow = late(exact, 1e-3)
    found = learned(flow, courses)
    assert judged(flow, courses) == pytest.approx(1e-3 * np.sqrt(10), rel=0.1)  # the root of k is taken off
    assert judged(found, courses) < 1e-5 * np.sqrt(10)


def test_a_flow_that_is_hardly_late_stays(exact, courses):
    flow = late(exact, 2e-5)  # after 10 samples late by so much times the root of 10
    assert learned(flow, courses) is flow
    flow = late(exact, 2e-4)
    assert learned(flow, courses) is not flow


def test_terms_that_are_zero_stay_so(exact, courses):
    polynomial = exact.polynomial.copy()
    polynomial[0, 0] = 0.0
    flow = dataclasses.replace(late(exact, 1e-3), polynomial=polynomial)
    found = learned(flow, courses, steps=20)
    assert found is not flow
    np.testing.assert_array_equal(found.polynomial == 0, polynomial == 0)


def test_inputs_act_along_courses():
    """In units of which none is 1: the exact flow is never late, and one that knows of no input is."""
    rng, system = np.random.default_rng(0), Oscillator()
    courses = draw_courses(system, rng.uniform(-1, 1, (300, 2)), rng.uniform(-0.5, 0.5, (300, 1)), DT)
    flow = exact_flow()
    deaf = dataclasses.replace(flow, polynomial=flow.polynomial * [1, 1, 1, 0])
    assert judged(flow, courses) < 1e-6
    assert judged(deaf, courses) > 0.1


def test_courses_that_leave_the_bounds_or_become_too_fast_are_left_out(monkeypatch):
    (_, high), _ = Oscillator().bounds
    x = np.array([[0.0, 0.0], [0.99 * high, 10.0 * high], [0.1, 0.1]])
    assert len(draw_courses(Oscillator(), x, np.zeros((3, 0)), DT).u) < 3

    def fails(*_, **__):
        raise SubstepsError("too fast")

    monkeypatch.setattr(ahead, "simulate", fails)
    assert draw_courses(Oscillator(), np.zeros((3, 2)), np.zeros((3, 0)), DT).x.shape == (21, 0, 2)


def test_what_learning_spoils_or_cannot_judge_is_not_taken(exact, courses, monkeypatch):
    flow = late(exact, 1e-2)
    few = ahead.Courses(courses.x[:, :199], courses.u[:199])
    assert learned(flow, few) is flow
    monkeypatch.setattr(ahead, "LEARNING_RATE", 10.0)
    assert learned(flow, courses, steps=3) is flow
    monkeypatch.setattr(
        AheadProblem, "loss", lambda problem, generator: {"loss": problem.correction.sum() * float("nan")}
    )
    assert learned(flow, courses, steps=3) is flow
