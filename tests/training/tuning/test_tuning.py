"""Choosing a spectrum, against closed forms on a linear system."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from linear_system import F, Oscillator
from scipy.linalg import expm

import training.tuning.probe
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from training.kalman import ExtendedKalmanFilter, unknown_start
from training.seeds import Stream, generator
from training.trajectories.derivatives import with_sensitivity
from training.tuning import Probe, Spectrum

SPECTRUM = Spectrum((-2.0, -0.7), ((-0.3, 1.0),))


def made(**changes):
    """The oscillator with other attributes."""
    return type("Made", (Oscillator,), {"name": "made", **changes})()


START = unknown_start(Oscillator())[1]


@pytest.fixture(scope="module")
def probe():
    return Probe(Oscillator(), duration=6.0, motions=8)


@pytest.fixture
def _small_library(monkeypatch):
    monkeypatch.setattr(training.tuning.probe, "REAL_MODES", 6)
    monkeypatch.setattr(training.tuning.probe, "DECAYS", 2)


def relative(probe, covariance):
    """What a covariance at each of the probe's ages, of all motions or each, amounts to."""
    root = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)).reshape(len(probe.ages), -1)
    size = np.linalg.norm(probe.x[probe.ages], axis=-1)
    return 100 * probe.share @ np.minimum(root / size, 2.0).mean(1)


def test_motions_start_where_no_other_stream_of_random_numbers_does():
    drawn = generator(Stream.TUNING, 3).uniform(*Oscillator().box(), (4, 2))
    np.testing.assert_array_equal(Probe(Oscillator(), duration=1.0, motions=2, seed=3).x[0], drawn[:2])
    with pytest.raises(ValueError, match="seed = -1"):
        Probe(Oscillator(), seed=-1)


def test_no_linear_decoder_of_noisy_z_does_better_and_one_does_as_well(probe, monkeypatch):
    monkeypatch.setattr(training.tuning.probe, "RESOLUTION", 0.0)
    rng, n, sigma = np.random.default_rng(0), 8000, 0.4
    x = [rng.normal(size=(n, 2)) * np.sqrt(np.diag(START))]
    for _ in range(600):
        x.append(x[-1] @ expm(0.01 * F).T)
    y = probe.system.output(np.array(x)) + sigma * rng.normal(size=(601, n, 1))
    z = SPECTRUM.filter(1, 0.01).run(y, np.zeros((600, n, 0)), probe.ages)
    left = []
    for i, age in enumerate(probe.ages):
        best, *_ = np.linalg.lstsq(z[i], x[age], rcond=None)
        error = x[age] - z[i] @ best
        left.append(error.T @ error / (n - z.shape[-1]))
    assert relative(probe, np.array(left)) == pytest.approx(probe.error(SPECTRUM, sigma), rel=0.02)


def test_the_least_error_is_that_of_a_kalman_filter(probe):
    kalman = ExtendedKalmanFilter(
        probe.system, 0.01, Q=np.zeros((2, 2)), R=0.09 * np.eye(1), start=(np.zeros(2), START)
    )
    kalman.reset(probe.y[0])
    P = [kalman.P[0]]
    for y in probe.y[1:]:
        kalman.step(y)
        P.append(kalman.P[0])
    P = np.array(P)[probe.ages]
    assert relative(probe, P) == pytest.approx(probe.least(0.3), rel=1e-6)
    assert probe.least(0.3) < probe.error(SPECTRUM, 0.3)
    of_states = probe.share @ np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    np.testing.assert_allclose(probe.error_of_states(None, 0.3), of_states, rtol=1e-6)
    assert (probe.error_of_states(SPECTRUM, 0.3) > of_states).all()
    back = expm(-0.01 * probe.ages[-1] * F)
    unknown = back @ P[-1] @ back.T / np.sqrt(np.outer(*2 * [np.diag(START)]))  # in the start's standard deviations
    np.testing.assert_allclose(probe.unknown_of_starts(0.3), unknown, rtol=1e-5, atol=1e-9)


def test_chaotic_motions_are_followed_as_far_as_numbers_go():
    """The recursion of Riccati, which forgets what is lost, against the sum over all samples."""
    system = get_system("lorenz")
    probe = Probe(system, dt=0.02, duration=20.0, motions=2)
    assert 1e4 < np.abs(probe.Phi).max() < 1e5
    assert len(probe.x) < 900
    before = probe.x[:-1].reshape(-1, 3)
    joint = np.hstack([before, np.tile(np.eye(3).ravel(), (len(before), 1))])
    steps = simulate(with_sensitivity(system, driven=False), joint, 1, 0.02)[1][:, 3:].reshape(-1, 2, 3, 3)
    P, H, left = np.broadcast_to(unknown_start(system)[1], (2, 3, 3)), np.array([[0.0, 1.0, 0.0]]), []
    for step in (np.broadcast_to(np.eye(3), (2, 3, 3)), *steps):
        P = step @ P @ step.mT
        P = (np.eye(3) - P @ H.T / (H @ P @ H.T + 0.25) @ H) @ P
        left.append(P)
    assert probe.least(0.5) == pytest.approx(relative(probe, np.array(left)[probe.ages]), rel=1e-3)


def test_errors_fall_with_modes_and_those_of_the_library_are_those_of_the_spectrum(probe):
    found = probe.choose(0.3, 5)
    assert 3 <= found[-1].spectrum.modes <= 5
    alone = [probe.error(Spectrum((), (pair,)), 0.3) for pair in probe.library.pairs[::3]]
    assert min(alone) >= found[1].error
    assert probe.error(found[-1].spectrum, 0.3) == pytest.approx(found[-1].error, rel=1e-5)
    assert probe.least(0.3) < found[-1].error < probe.error(Spectrum((-2.0, -0.7)), 0.3)
    assert probe.error(SPECTRUM, 0.1) < probe.error(SPECTRUM, 0.4)
    assert probe.error(Spectrum((), ((-0.5, 1.0),)), 0.5) < probe.error(Spectrum((), ((-5.0, 1.0),)), 0.5)


def test_choices_begin_with_given_modes(probe):
    given = Spectrum(probe.library.eigenvalues[:2], probe.library.pairs[:1])
    begun = replace(probe, start=given)
    found = begun.choose(0.5, most=6)
    assert found[0].spectrum == given
    assert found[0].error == pytest.approx(probe.error(given, 0.5), rel=1e-6)
    for before, after in pairwise(found):
        assert after.error < before.error
        assert after.spectrum.eigenvalues[:2] == given.eigenvalues
        assert len(set(after.spectrum.poles)) == after.spectrum.modes  # none twice
    assert 4 < found[-1].spectrum.modes <= 6
    anew = begun.choose(0.5, most=3, anew=True)
    assert [choice.spectrum for choice in anew] == [choice.spectrum for choice in probe.choose(0.5, most=3)]


def test_bessel_filters_have_their_poles(probe):
    """At the cutoff the gain is down by 3 dB."""
    (third,) = probe.bessel(0.1, [3], [2.0])
    poles = third.spectrum.poles
    assert len(poles) == third.spectrum.modes == 3
    assert np.prod(np.abs(poles / (2.0j - poles))) == pytest.approx(1 / np.sqrt(2), rel=1e-6)


@pytest.mark.usefixtures("_small_library")
def test_several_outputs_have_all_modes_each_and_noise_of_their_own():
    both, one = (Probe(each, duration=6.0, motions=4) for each in (made(h=lambda self, x: (x[0], x[1])), Oscillator()))
    last = both.choose(0.3, 3)[-1]
    assert both.error(last.spectrum, 0.3) == pytest.approx(last.error, rel=1e-6)
    assert last.error < one.error(last.spectrum, 0.3)
    assert both.error(SPECTRUM, (0.3, 0.3)) == both.error(SPECTRUM, 0.3)
    assert both.least((0.3, 1e6)) == pytest.approx(one.least(0.3), rel=1e-6)
    assert both.error(SPECTRUM, (0.3, 1e6)) == pytest.approx(one.error(SPECTRUM, 0.3), rel=1e-4)


def test_an_output_that_does_not_move_leaves_the_start_unknown():
    probe = Probe(made(h=lambda self, x: (0.0 * x[0],)), duration=6.0, motions=4)
    assert not len(probe.frequencies)
    (only,) = probe.choose(0.3)
    carried = [expm(age * 0.01 * F) @ START @ expm(age * 0.01 * F).T for age in probe.ages]
    assert only.error == pytest.approx(relative(probe, np.array(carried)), rel=1e-4)


@pytest.mark.usefixtures("_small_library")
def test_motions_that_end_in_a_point():
    """They underflow to zero; of two outputs of different size one is at rest."""
    decaying = made(
        f=lambda self, x: (-400.0 * x[0] + x[1], -500.0 * x[1]), h=lambda self, x: (x[0] + 1e3 * x[1], 0.0 * x[0])
    )
    probe = Probe(decaying, dt=0.004, duration=2.0, motions=2)
    assert np.abs(probe.x[-1]).max() < 1e-300
    assert 0 < probe.choose(0.3, 2)[-1].error < 200


def test_a_policy_does_not_change_how_well_a_linear_system_is_known(probe):
    """It chooses the inputs, which the observer knows."""
    driven = Probe(Oscillator(), duration=6.0, motions=8, policy=lambda x: np.tanh(x[:, :1]))
    np.testing.assert_array_equal(driven.x[0], probe.x[0])
    assert (np.abs(driven.x[-1] - probe.x[-1]) > 0.01).any(1).all()
    np.testing.assert_allclose(driven.Phi, probe.Phi, rtol=1e-9)
    np.testing.assert_allclose(driven.error_of_states(None, 0.3), probe.error_of_states(None, 0.3), rtol=1e-9)


def test_predictions_do_not_depend_on_the_units_of_states(probe):
    """The oscillator with x2 in thousandths, about another point."""
    other = made(
        X=((4.0, 6.0), (6000.0, 8000.0)),
        bounds=((-25.0, 35.0), (-23000.0, 37000.0)),
        f=lambda self, x: (1e-3 * x[1] - 7.0, -1e3 * (x[0] - 5.0)),
    )
    other = Probe(other, duration=6.0, motions=8)
    assert other.error(SPECTRUM, 0.3) == pytest.approx(probe.error(SPECTRUM, 0.3), rel=1e-6)
    assert other.least(0.3) == pytest.approx(probe.least(0.3), rel=1e-6)
    in_units = probe.error_of_states(SPECTRUM, 0.3) * [1.0, 1000.0]
    np.testing.assert_allclose(other.error_of_states(SPECTRUM, 0.3), in_units, rtol=1e-6)
