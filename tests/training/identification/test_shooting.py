"""Windows of records: standard errors, and first guesses that explain nothing."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.identification import windows as fitting
from training.identification.identify import _brought_back, nearest
from training.identification.motions import Problem, Shooting, Windows
from training.identification.shooting import UnexplainedError, believed, shoot
from training.identification.windows import fit_windows
from training.records import Record


@dataclass(frozen=True)
class Decay(System):
    """x' = -rate x + noise, y = gain x."""

    rate_constant: float = 1.0
    gain: float = 1.0

    name: ClassVar[str] = "decay"
    X: ClassVar = ((0.5, 1.5),)
    bounds: ClassVar = ((-2.0, 2.0),)
    dt: ClassVar = 0.02

    def f(self, x):
        return (-self.rate_constant * x[0],)

    def h(self, x):
        return (self.gain * x[0],)


@dataclass(frozen=True)
class Swing(System):
    """A mass on a spring."""

    stiffness: float = 4.0

    name: ClassVar[str] = "swing"
    X: ClassVar = ((-1.0, 1.0), (-2.0, 2.0))
    bounds: ClassVar = ((-9.0, 9.0), (-30.0, 30.0))
    dt: ClassVar = 0.02

    def f(self, x):
        return x[1], -self.stiffness * x[0]

    def h(self, x):
        return (x[0],)


def windows(system, n, steps, *, noise, process_noise, seed):
    """Windows of motions from X, with true starts."""
    rng = np.random.default_rng(seed)
    x0 = system.draw_starts(rng, n)
    x = simulate(system, x0, steps, system.dt, w=process_noise * rng.standard_normal((steps, n, system.nx)))
    y = system.output(x)
    return Windows(y + noise * rng.standard_normal(y.shape), np.zeros((steps, n, 0)), x0)


def fitted(measured, **guesses):
    limits = {name: (value / 10, value * 10) for name, value in guesses.items()}
    system = Decay().replace(guesses)
    values = np.array(list(guesses.values()))
    shooting = Shooting(system, system.dt, limits, values)
    return shooting, shoot(shooting, values, measured)


def test_windows_count_less_the_worse_they_are_explained():
    """Against the best rate of a search in one dimension, with the best starts in closed form."""
    good = windows(Decay(), 20, 60, noise=0.01, process_noise=0.0, seed=0)
    rough = windows(Decay(rate_constant=1.3), 15, 60, noise=0.01, process_noise=0.0, seed=1)
    both = Windows(*(np.concatenate([getattr(w, each) for w in (good, rough)], axis) for each, axis in AXES.items()))
    shooting = Shooting(Decay(), Decay.dt, {"rate_constant": (0.1, 10.0)}, np.array([1.0]))

    def counted(rate):
        shape = np.exp(-rate * Decay.dt * np.arange(61))
        x0 = shape @ both.y[..., 0] / (shape @ shape)
        return np.log1p(((both.y[..., 0] - shape[:, None] * x0) ** 2).mean(0) / 0.01**2).sum()

    best = minimize_scalar(counted, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-6}).x
    fit = shoot(shooting, np.array([0.9]), both, noise=(0.01,), precision=1e-4, rounds=100)
    assert fit.parameters["rate_constant"] == pytest.approx(best, abs=1e-3)
    for wrong in ((0.01, 0.01), (0.0,), (np.nan,)):
        with pytest.raises(ValueError, match="1 positive numbers"):
            shoot(shooting, np.array([0.9]), both, noise=wrong)
    alike = shoot(shooting, np.array([0.9]), both).parameters["rate_constant"]
    assert abs(fit.parameters["rate_constant"] - 1.0) < abs(alike - 1.0) / 2


AXES = {"y": 1, "u": 1, "x0": 0}  # along which windows follow each other


@pytest.mark.parametrize(("process_noise", "coloured"), [(0.0, False), (0.3, True)])
def test_standard_errors_cover_the_truth_under_process_noise(process_noise, coloured):
    """Normalised errors are standard normal: where noise is white, and where windows alone show what it does."""
    off, white = [], []
    for seed in range(12):
        measured = windows(Decay(), 40, 60, noise=0.01, process_noise=process_noise, seed=seed)
        _, fit = fitted(measured, rate_constant=1.1)
        assert fit.coloured == coloured
        off.append((fit.parameters["rate_constant"] - 1.0) / fit.standard_errors[0])
        white.append(fit.white[0, 0] ** 0.5 / fit.curvature[0, 0] * 1.1 / fit.standard_errors[0])
    assert 0.5 < np.std(off) < 1.6
    assert abs(np.mean(off)) < 1.0
    assert (np.mean(white) < 0.5) == coloured


def recorded_swings(process_noise, n, steps):
    """Records of the swing, its shooting, and the true state as a guess."""
    rng = np.random.default_rng(1)
    w = process_noise * rng.standard_normal((steps, n, 2))
    x = simulate(Swing(), Swing().draw_starts(rng, n), steps, Swing.dt, w=w)
    y = x[..., :1] + 0.02 * rng.standard_normal((steps + 1, n, 1))
    records = [Record(str(i), Swing.dt * np.arange(steps + 1), y[:, i]) for i in range(n)]
    shooting = Shooting(Swing(), Swing.dt, {"stiffness": (0.4, 40.0)}, np.array([4.0]))
    return shooting, records, lambda record, at: x[at, int(record.name)]


@pytest.mark.parametrize(("exact", "taken"), [((), 40), ((20,), 20), ((40, 20), 20)])
def test_where_no_first_fit_comes_to_rest_the_nearest_one_counts(exact, taken, monkeypatch):
    """Not that of the shortest windows, which may not have moved, unless it explains them best, to rounding."""
    left = {80: 1.5, 40: 1.2, 20: 5.0}
    cost = {length: 1e-20 * length if length in exact else 1.0 for length in left}

    def stuck(*arguments, **options):
        fit = shoot(*arguments, **options)
        return replace(fit, left=left[len(fit.windows.u)], cost=cost[len(fit.windows.u)])

    monkeypatch.setattr(fitting, "FIRST_LENGTHS", tuple(left))
    monkeypatch.setattr(fitting, "shoot", stuck)
    shooting, records, guess = recorded_swings(0.0, 10, 80)
    fit, _, length = fitting._first_fit(shooting, [np.array([4.1])], records, guess, first=0, longest=80)
    assert (length, len(fit.windows.u), fit.left) == (taken, taken, left[taken])


@pytest.mark.parametrize(("process_noise", "length"), [(0.0, 160), (0.1, 40)])
def test_windows_grow_while_residuals_are_white(process_noise, length, monkeypatch):
    monkeypatch.setattr(fitting, "FIRST_LENGTHS", (20,))
    shooting, records, guess = recorded_swings(process_noise, 45, 160)
    fit = fit_windows(shooting, [np.array([4.1])], records, guess, first=0)
    assert len(fit.windows.u) == length
    assert abs(fit.parameters["stiffness"] - 4.0) < 3 * fit.standard_errors[0] < 0.3


def test_standard_errors_are_of_any_units():
    """Outputs tell a parameter that came out far larger than its unit, and none of a second in sum with a third."""
    _, fit = fitted(windows(Decay(), 5, 60, noise=0.01, process_noise=0.0, seed=0), rate_constant=1.1)
    told = np.diag([1e4, 1e-4, 1.0, 1.0])
    told[2, 3] = told[3, 2] = 1.0
    found = replace(
        fit,
        parameters={"a": 1.0, "b": 1e5, "c": 1.0, "d": 1.0},
        unit=np.ones(4),
        information=told,
        curvature=told,
        white=told,
    )
    assert found.standard_errors == pytest.approx([0.01, 100.0, np.inf, np.inf])


def test_few_windows_say_nothing_of_their_scatter():
    measured = windows(Decay(), 10, 60, noise=0.01, process_noise=0.3, seed=0)
    _, fit = fitted(measured, rate_constant=1.1)
    assert not fit.coloured
    assert fit.standard_errors[0] == pytest.approx(1.1 * fit.white[0, 0] ** 0.5 / fit.curvature[0, 0])


def test_guesses_that_explain_nothing():
    measured = windows(Decay(), 5, 60, noise=0.01, process_noise=0.0, seed=0)
    shooting = Shooting(Decay(-40.0), 0.02, {"rate_constant": (-50.0, -30.0)}, np.array([40.0]))
    with pytest.raises(UnexplainedError, match=r"windows of 60 samples: all motions leave the bounds of decay.*-40"):
        shoot(shooting, np.array([-40.0]), measured)


def test_parameters_go_back_no_further_than_bounds_let_states():
    """y tells gain times x. As x of up to 1.5 may grow to 2 alone, the gain of 0.25 that was given is too small."""
    measured = windows(Decay(), 20, 60, noise=0.001, process_noise=0.0, seed=0)
    shooting, fit = fitted(measured, gain=1.0)
    found = _brought_back(shooting, fit, np.array([0.25]))
    assert 0.7 < found.parameters["gain"] < 0.9
    assert found.cost == pytest.approx(fit.cost, rel=0.1)


def test_what_outputs_say_nothing_of_stays_as_it_was_given():
    assert nearest(np.array([3.0, 7.0]), np.array([2.5, 2.0]), np.array([[0.0], [1.0]])).tolist() == [3.0, 2.0]


def test_derivatives_are_those_of_closed_form():
    """x = x0 exp(-a t) and y = b x, and their derivatives."""
    system = Decay(1.3, 0.7)
    shooting = Shooting(system, system.dt, {"rate_constant": (0.1, 9.0), "gain": (0.1, 9.0)}, np.array([1.3, 0.7]))
    x0, u, t = np.array([[0.5], [1.2]]), np.zeros((100, 2, 0)), np.arange(101)[:, None] * system.dt
    theta = np.array([1.3, 0.7])
    y = shooting.outputs(np.tile(theta, (2, 1)), x0, u)
    J = shooting.derivatives(theta, x0, u, y=y)[:, :, 0]
    decayed = np.exp(-1.3 * t)
    by_start, by_rate, by_gain = 0.7 * decayed + 0 * x0.T, -0.7 * t * x0.T * decayed, x0.T * decayed
    np.testing.assert_allclose(J, np.stack([0.5 * by_start, 1.3 * by_rate, 0.7 * by_gain], -1), rtol=1e-5, atol=1e-6)


def test_starts_far_from_right_are_found_by_way_of_the_beginnings():
    """Squares of two seconds of a chaotic motion have minima that trap a start two units away."""
    plant, rng = get_system("lorenz"), np.random.default_rng(0)
    x0 = simulate(plant, plant.draw_starts(rng, 20), 500, plant.dt)[-1]
    y = plant.output(simulate(plant, x0, 200, plant.dt))
    measured = Windows(
        y + 0.1 * rng.standard_normal(y.shape), np.zeros((200, 20, 0)), x0 + 2 * rng.standard_normal(x0.shape)
    )
    shooting = Shooting(plant, plant.dt, {"rho": (20.0, 40.0)}, np.array([28.0]))
    fit = shoot(shooting, np.array([27.9]), measured)
    assert fit.used.all()
    assert fit.noise[0] == pytest.approx(0.1, rel=0.05)
    assert fit.left < 0.2
    assert abs(fit.parameters["rho"] - 28) < 4 * fit.standard_errors[0]


def swings(n, moving, seed=0):
    """Windows of a mass on a spring, of which only some move."""
    system, rng = Swing(), np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, n)
    x0 = np.where(np.arange(n) < moving, 1.0, 0.0)[:, None] * np.stack([np.cos(phase), 2 * np.sin(phase)], 1)
    y = system.output(simulate(system, x0, 100, system.dt))
    measured = Windows(y + 0.01 * rng.standard_normal(y.shape), np.zeros((100, n, 0)), x0)
    return Shooting(system, system.dt, {"stiffness": (0.4, 40.0)}, np.array([4.0])), measured


@pytest.mark.parametrize("moving", [5, 12])
def test_few_windows_may_tell_all_there_is(moving):
    """Windows at rest tell no stiffness; those that move are believed, however much more they claim."""
    shooting, measured = swings(30, moving)
    fit = shoot(shooting, np.array([4.2]), measured)
    assert fit.used[:moving].all()
    assert fit.standard_errors[0] < 0.01
    assert abs(fit.parameters["stiffness"] - 4) < 4 * fit.standard_errors[0]


def test_a_window_that_claims_what_it_does_not_show_is_not_believed(monkeypatch):
    """Its derivatives by the parameter are a hundred times too large."""
    shooting, measured = swings(30, 30)
    derivatives = Problem.derivatives

    def exaggerated(self, theta, at, rows, *, parameters=True):
        J = derivatives(self, theta, at, rows, parameters=parameters).copy()
        J[:, rows == 7, :, 2:] *= 100
        return J

    monkeypatch.setattr(Problem, "derivatives", exaggerated)
    problem, theta = Problem(shooting, measured), np.array([4.0])
    at = problem.settled(theta)
    trusted = believed(problem, theta, at, np.ones(30, dtype=bool), at.each.mean())
    assert np.flatnonzero(~trusted).tolist() == [7]
