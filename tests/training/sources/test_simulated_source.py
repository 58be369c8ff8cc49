"""Simulated sources: motions for training and calibration, and equations for a tracker."""

import numpy as np
import pytest
from discrete_systems import Sampled
from linear_system import Autonomous, Oscillator
from pushed_systems import Pendulum
from small_runs import toy

from kkl_gym import VanDerPol
from kkl_gym.elementary import sign
from kkl_gym.simulate import simulate
from training import SimulatedSource
from training.sources import simulated
from training.sources.simulated import INTEGRATION_ERROR


class Stiff(VanDerPol):
    name, bounds = "stiff", ((-12, 12), (-200, 200))


class Rubbing(Autonomous):
    """The oscillator with dry friction, a jump where the speed changes sign."""

    name = "rubbing"

    def f(self, x):
        return x[1], -x[0] - 0.3 * sign(x[1])


@pytest.mark.parametrize(
    ("system", "least"), [(VanDerPol(), 1), (Stiff(mu=40.0), 4), (Pendulum(), 1), (Rubbing(), 1), (Sampled(), 0)]
)
def test_substeps_of_the_equations_suffice(system, least):
    source = SimulatedSource(system, toy(system, eigenvalues=(-1.0,)))
    equations, rng = source.equations(), np.random.default_rng(1)
    assert equations.substeps >= least
    assert equations.substeps & (equations.substeps - 1) == 0
    u = rng.uniform(-1, 1, (100, 200, system.nu)) * system.u_max
    x = simulate(system, system.draw_starts(rng, 200), 100, source.dt, u=u)
    off = (equations(x[:-1], u, source.dt) - x[1:]) / source.tracking()["x_scale"]
    assert np.quantile(np.abs(off).max(-1), 0.98) < (0.01 if system.name == "rubbing" else 3 * INTEGRATION_ERROR)


def test_equations_that_are_too_stiff_are_left_to_a_flow(monkeypatch):
    monkeypatch.setattr(simulated, "SUBSTEPS", 2)
    with pytest.raises(ValueError, match=r"2 Runge-Kutta steps per 0\.01 s err by .* > 0\.01 standard deviations"):
        SimulatedSource(Stiff(mu=40.0), toy(Stiff(), eigenvalues=(-1.0,))).equations()


def test_increments_are_those_of_the_system():
    system = Pendulum()
    learned, judged = SimulatedSource(system, toy(system)).increments()
    assert len(judged.x) == pytest.approx(len(learned.x) / 19, rel=0.01)
    later = simulate(system, judged.x[:500], 1, system.dt, u=judged.u[None, :500])[-1]
    np.testing.assert_allclose(judged.change[:500], later - judged.x[:500], atol=1e-12)
    assert (judged.u == 0).all(-1).mean() == pytest.approx(0.75, abs=0.1)  # 1/2 + 1/2 * 1/2


def test_motions_for_calibration_are_with_and_without_process_noise():
    source = SimulatedSource(Oscillator(), toy(Oscillator(), dt=0.05))
    runs = source.runs()
    assert runs.x.shape == (401, 100, 2)
    np.testing.assert_allclose(np.unique(runs.process_noise), [0.0, 0.05])
    np.testing.assert_array_equal(runs.y, runs.x[..., :1])
    driven = (runs.u != 0).any((0, 2))
    assert 0.4 < driven.mean() < 0.6
    assert runs.usual.mean() == pytest.approx(2 / 3, abs=0.12)
    assert (np.abs(runs.x[0]).max(-1)[runs.usual] <= 1).all()
    quiet = runs.process_noise == 0
    expected = simulate(Oscillator(), runs.x[0], 400, 0.05, u=runs.u)
    off = np.abs(runs.x - expected).max((0, 2))
    assert (off[quiet] == 0).all()
    assert (off[~quiet] > 0.01).all()
    np.testing.assert_array_equal(source.runs().x, runs.x)
