"""Multiple shooting: weights of windows, standard errors, and initial guesses that fit no window."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from spring import Spring

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.identification import windows as fitting
from training.identification.motions import Problem, Shooting, Windows
from training.identification.shooting import UnexplainedError, shoot
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
    dt: ClassVar = 0.06

    def f(self, x):
        return (-self.rate_constant * x[0],)

    def h(self, x):
        return (self.gain * x[0],)


SWING = Spring(damping=0.0)


def windows(system, n, steps, *, noise, process_noise, seed):
    """Windows of motions from X, with their true initial states."""
    rng = np.random.default_rng(seed)
    x0 = system.draw_starts(rng, n)
    x = simulate(system, x0, steps, system.dt, w=process_noise * rng.standard_normal((steps, n, system.nx)))
    y = system.output(x)
    return Windows(y + noise * rng.standard_normal(y.shape), np.zeros((steps, n, 0)), x0)


def fitted(measured):
    """Fit the rate, from an initial guess of 1.1."""
    shooting = Shooting(Decay(1.1), Decay.dt, {"rate_constant": (0.11, 11.0)}, np.array([1.1]))
    return shoot(shooting, np.array([1.1]), measured)


def test_windows_with_large_residuals_have_small_weights():
    """Compare with a one-dimensional search for the rate, with the optimal initial states in closed form."""
    good = windows(Decay(), 20, 20, noise=0.01, process_noise=0.0, seed=0)
    rough = windows(Decay(rate_constant=1.3), 15, 20, noise=0.01, process_noise=0.0, seed=1)
    both = Windows(*(np.concatenate([getattr(w, each) for w in (good, rough)], axis) for each, axis in AXES.items()))
    shooting = Shooting(Decay(), Decay.dt, {"rate_constant": (0.1, 10.0)}, np.array([1.0]))

    def counted(rate):
        shape = np.exp(-rate * Decay.dt * np.arange(21))
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


AXES = {"y": 1, "u": 1, "x0": 0}  # the axes of windows


@pytest.mark.parametrize(("process_noise", "coloured"), [(0.0, False), (0.3, True)])
def test_standard_errors_cover_the_truth_under_process_noise(process_noise, coloured):
    """Normalised errors are standard normal, also for coloured residuals, where the spread of windows is used."""
    off, white = [], []
    for seed in range(12):
        measured = windows(Decay(), 40, 20, noise=0.01, process_noise=process_noise, seed=seed)
        fit = fitted(measured)
        assert fit.coloured == coloured
        off.append((fit.parameters["rate_constant"] - 1.0) / fit.standard_errors[0])
        white.append(fit.white[0, 0] ** 0.5 / fit.curvature[0, 0] * 1.1 / fit.standard_errors[0])
    assert 0.5 < np.std(off) < 1.6
    assert abs(np.mean(off)) < 1.0
    assert (np.mean(white) < 0.5) == coloured


@pytest.mark.parametrize(("process_noise", "length"), [(0.0, 64), (0.1, 16)])
def test_windows_grow_while_residuals_are_white(process_noise, length, monkeypatch):
    monkeypatch.setattr(fitting, "FIRST_LENGTHS", (8,))
    rng, steps, n = np.random.default_rng(1), 64, 45
    w = process_noise * rng.standard_normal((steps, n, 2))
    x = simulate(SWING, SWING.draw_starts(rng, n), steps, SWING.dt, w=w)
    y = x[..., :1] + 0.02 * rng.standard_normal((steps + 1, n, 1))
    records = [Record(str(i), SWING.dt * np.arange(steps + 1), y[:, i]) for i in range(n)]
    shooting = Shooting(SWING.replace({"stiffness": 4.1}), SWING.dt, {"stiffness": (0.4, 40.0)}, np.array([4.0]))
    fit = fit_windows(shooting, records, rng)
    assert len(fit.windows.u) == length
    assert abs(fit.parameters["stiffness"] - 4.0) < 3 * fit.standard_errors[0] < 0.3


def test_guesses_that_fit_no_window():
    measured = windows(Decay(), 5, 20, noise=0.01, process_noise=0.0, seed=0)
    shooting = Shooting(Decay(-40.0), 0.02, {"rate_constant": (-50.0, -30.0)}, np.array([40.0]))
    with pytest.raises(UnexplainedError, match=r"windows of 20 samples: all motions leave the bounds of decay.*-40"):
        shoot(shooting, np.array([-40.0]), measured)


def test_derivatives_are_those_of_closed_form():
    """For x = x0 exp(-a t) and y = b x."""
    system = Decay(1.3, 0.7)
    shooting = Shooting(system, system.dt, {"rate_constant": (0.1, 9.0), "gain": (0.1, 9.0)}, np.array([1.3, 0.7]))
    x0, u, t = np.array([[0.5], [1.2]]), np.zeros((100, 2, 0)), np.arange(101)[:, None] * system.dt
    theta = np.array([1.3, 0.7])
    y = shooting.outputs(np.tile(theta, (2, 1)), x0, u)
    J = shooting.derivatives(theta, x0, u, y=y)[:, :, 0]
    decayed = np.exp(-1.3 * t)
    by_start, by_rate, by_gain = 0.7 * decayed + 0 * x0.T, -0.7 * t * x0.T * decayed, x0.T * decayed
    np.testing.assert_allclose(J, np.stack([0.5 * by_start, 1.3 * by_rate, 0.7 * by_gain], -1), rtol=1e-5, atol=1e-6)


def test_random_starts_lead_to_the_state():
    """Over 1.5 s of a chaotic motion, local minima trap an initial state that is off by three units."""
    plant, rng = get_system("lorenz"), np.random.default_rng(2)
    x0 = simulate(plant, plant.draw_starts(rng, 8), 500, plant.dt)[-1]
    y = plant.output(simulate(plant, x0, 150, plant.dt))
    measured = Windows(y + 0.1 * rng.standard_normal(y.shape), np.zeros((150, 8, 0)), np.zeros((8, 3)))
    shooting = Shooting(plant, plant.dt, {"rho": (20.0, 40.0)}, np.array([28.0]))
    at = Problem(shooting, measured).searched(np.array([27.9]), rng)
    np.testing.assert_allclose(at.x0, x0, atol=1.0)
    fit = shoot(shooting, np.array([27.9]), replace(measured, x0=at.x0))
    assert fit.used.all()
    assert fit.noise[0] == pytest.approx(0.1, rel=0.05)
    assert fit.left < 0.2
    assert abs(fit.parameters["rho"] - 28) < 4 * fit.standard_errors[0]


def test_few_informative_windows_suffice():
    """Windows at rest do not determine the stiffness; the moving windows are used despite their larger information."""
    n, rng = 30, np.random.default_rng(0)
    phase = rng.uniform(0, 2 * np.pi, n)
    x0 = np.stack([np.cos(phase), 2 * np.sin(phase)], 1) * (np.arange(n) < 5)[:, None]
    y = SWING.output(simulate(SWING, x0, 40, SWING.dt))
    measured = Windows(y + 0.01 * rng.standard_normal(y.shape), np.zeros((40, n, 0)), x0)
    shooting = Shooting(SWING, SWING.dt, {"stiffness": (0.4, 40.0)}, np.array([4.0]))
    fit = shoot(shooting, np.array([4.2]), measured)
    assert fit.used[:5].all()
    assert fit.standard_errors[0] < 0.01
    assert abs(fit.parameters["stiffness"] - 4) < 4 * fit.standard_errors[0]
