import functools
import math
import warnings

import numpy as np
import pytest
from kinked_systems import SYSTEMS as KINKED
from pushed_systems import Pendulum, TwoInputs

from kkl_gym import SYSTEMS, Lorenz, ReverseDuffing, Rossler, System, get_system
from kkl_gym.compiled import batch_step, single_step
from kkl_gym.elementary import exp, sign, sin
from kkl_gym.simulate import (
    SubstepsError,
    advance,
    advance_batch,
    runge_kutta,
    simulate,
)

solve_ivp = pytest.importorskip("scipy.integrate").solve_ivp
DT = 0.01


class Flushed(System):
    """A reactor that its input dilutes, x' = -0.02 x + (1 - x) u: slow without the input, fast with it."""

    name = "flushed"
    X = ((0.0, 1.0),)
    bounds = ((-5.0, 5.0),)
    u_max = (400.0,)

    def f(self, x):
        return (-0.02 * x[0],)

    def g(self, x):
        return ((1.0 - x[0],),)

    def h(self, x):
        return (x[0],)


def without_formula(name):
    kind = type(get_system(name))
    return type(kind.__name__, (kind,), {"name": name, "rate": System.rate})()


@pytest.mark.parametrize("find", [get_system, without_formula], ids=["rate", "error"])
@pytest.mark.parametrize(("name", "duration"), [
    ("reverse_duffing", 10.0), ("van_der_pol", 10.0), ("rossler", 10.0), ("lorenz", 2.0),
])  # fmt: skip
def test_accuracy_from_twice_the_training_box(name, duration, find):
    system, every = find(name), round(0.1 / DT)
    x0 = np.random.default_rng(7).uniform(*system.box(2), (200 if name in ("rossler", "lorenz") else 100, system.nx))
    found = simulate(system, x0, round(duration / DT), DT)[::every]
    stays = np.flatnonzero(np.isfinite(found[-1]).all(-1))[:100]
    assert len(stays) == 100

    def field(t, flat):
        return np.ravel(system.f(flat.reshape(system.nx, -1)))

    times, start = np.linspace(0, duration, len(found)), x0[stays].T.ravel()
    solution = solve_ivp(field, (0, duration), start, "DOP853", times, rtol=1e-10, atol=1e-12)
    expected = solution.y.reshape(system.nx, len(stays), -1).transpose(2, 1, 0)
    error = np.abs(found[:, stays] - expected).max((0, 2)) / np.abs(expected).max((0, 2))
    assert error.max() < 1e-5


class Relaxing(System):
    """Van der Pol's oscillator at mu = 200: slow, stiff phases with jumps of 0.01 s between them."""

    name = "relaxing"
    X, bounds = ((-2.5, 2.5), (-800.0, 800.0)), ((-9.0, 9.0), (-6000.0, 6000.0))

    def f(self, x):
        return x[1], 200.0 * (1.0 - x[0] * x[0]) * x[1] - x[0]

    def h(self, x):
        return (x[0],)


class Reacting(Relaxing):
    """Robertson's reaction; its fastest phase lasts 3e-5 of the interval."""

    name = "reacting"
    X, bounds = ((0.0, 1.0), (0.0, 1e-4), (0.0, 1.0)), ((-1.0, 2.0), (-1.0, 1.0), (-1.0, 2.0))

    def f(self, x):
        first, second, third = 0.04 * x[0], 3e7 * x[1] * x[1], 1e4 * x[1] * x[2]
        return third - first, first - second - third, second


class Clocked(Relaxing):
    """x2' is a sine of time, which is a state: slopes at the midpoint agree for all step sizes."""

    name = "clocked"
    X, bounds = ((0.0, 10.0), (-1.0, 1.0)), ((-1e3, 1e3), (-1e3, 1e3))

    def f(self, x):
        return 1.0, 30.0 * sin(40.0 * x[0])


@pytest.mark.parametrize(("system", "dt", "duration"), [
    (Relaxing(), 0.01, 1.0), (Reacting(), 0.1, 1.0), (Clocked(), 0.05, 5.0),
], ids=lambda value: getattr(value, "name", value))  # fmt: skip
def test_accuracy_of_stiff_and_time_driven_systems(system, dt, duration):
    x0 = system.draw_starts(np.random.default_rng(0), 4)
    found = simulate(system, x0, round(duration / dt), dt)
    times = np.linspace(0.0, duration, len(found))
    for row, start in enumerate(x0):
        solution = solve_ivp(
            lambda _, x: np.array(system.f(x)), (0, duration), start, "Radau", times, rtol=1e-10, atol=1e-13
        )
        error = np.abs(found[:, row] - solution.y.T).max(0) / np.abs(solution.y).max(1)
        assert error.max() < 1e-5


def test_order_six():
    def error(n):
        x, estimated = runge_kutta(2)(ReverseDuffing().f, (1.0, 1.0), (0.2, -0.1), 2.0 / n, n, (1e3, 1e3))
        assert np.abs(np.subtract(x, exact)).max() < 1e-3 * math.sqrt(estimated) * n
        return np.abs(np.subtract(x, exact)).max()

    exact = solve_ivp(
        lambda t, x: np.add(ReverseDuffing().f(x), (0.2, -0.1)), (0, 2), [1, 1], "DOP853", rtol=1e-13, atol=1e-14
    ).y[:, -1]
    errors = [error(n) for n in (8, 16, 32)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert ((orders > 5.5) & (orders < 7.0)).all()


def one_by_one(system, x0, u, w, dt):
    out = [x0]
    for uk, wk in zip(u.tolist(), w.tolist(), strict=True):
        rows = zip(out[-1].tolist(), uk, wk, strict=True)
        out.append(np.array([advance(system, x, ui, wi, dt) for x, ui, wi in rows]))
    return np.array(out)


@pytest.mark.parametrize("system", [*map(get_system, SYSTEMS), Pendulum(), TwoInputs(), *KINKED], ids=lambda s: s.name)
def test_scalar_and_batch_agree_to_rounding_in_each_step(system):
    rng, n, steps = np.random.default_rng(4), 20, 15
    x0 = rng.uniform(*system.box(2), (n, system.nx))
    u = rng.uniform(-1, 1, (steps, n, system.nu)) * system.u_max
    w = rng.uniform(-1, 1, (steps, n, system.nx))
    for dt in (0.003, 0.1):
        batch = simulate(system, x0, steps, dt, u, w)
        scalar = np.array([one_by_one(system, x, ui[None], wi[None], dt)[1] for x, ui, wi in zip(batch, u, w)])
        stays = np.isfinite(batch[-1]).all(-1)
        assert stays.sum() >= n // 2
        error = np.abs(batch[1:, stays] - scalar[:, stays]).max(-1)
        assert (error <= 1e-13 * (1.0 + np.abs(scalar[:, stays]).max(-1))).all()


def test_a_jump_takes_a_few_substeps():
    calls = []

    class Rubbing(Relaxing):
        name = "rubbing"
        X, bounds = ((-1.0, 1.0), (-1.0, 1.0)), ((-9.0, 9.0), (-9.0, 9.0))

        def f(self, x):
            calls.append(x)
            return x[1], -x[0] - 0.5 * sign(x[1])

    found = simulate(Rubbing(), [[1.0, 1.0]], 300, DT)
    assert np.abs(found[-1]).max() < 0.6  # friction stops the mass there
    assert len(calls) / 300 < 1000


def test_escape_leaves_nan_rows_and_no_warning():
    system = Rossler()
    x0 = np.array([[43.5, 44.2, -3.6], [1.0, 1.0, 1.0], [-48.3, 43.9, 455.9], [5.0, 5.0, 5.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        x = simulate(system, x0, 200, DT)
    gone = np.isnan(x).any(-1)
    assert np.isnan(x[gone]).all()
    assert (np.diff(gone.astype(int), axis=0) >= 0).all()  # a lost row stays lost
    assert gone[-1].tolist() == [True, False, True, False]
    low, high = np.array(system.bounds).T
    assert ((x[~gone] >= low) & (x[~gone] <= high)).all()


class Igniting(Relaxing):
    """x1' = -r, x2' = 100 r with r = x1 exp(0.06 x2): slow at first, then 400 times as fast, within one interval."""

    name = "igniting"
    X = ((0.5, 1.0), (0.0, 3.0))
    bounds = ((0.0, 1.1), (-1.0, 110.0))

    def f(self, x):
        r = x[0] * exp(0.06 * x[1])
        return -r, 100.0 * r


class Rated(Igniting):
    name = "rated"

    def rate(self, x):
        return exp(0.06 * x[1]) * (1.0 + 6.0 * abs(x[0]))


@pytest.mark.parametrize("system", [Igniting(), Rated()], ids=lambda s: s.name)
def test_a_reaction_that_ignites_within_an_interval_is_resolved(system):
    dt = 1.0
    starts = np.array([(1.0, 0.0), (0.7, 2.0)])
    expected = np.array(
        [solve_ivp(lambda _, x: system.f(x), (0, dt), x0, "LSODA", rtol=1e-10, atol=1e-12).y[:, -1] for x0 in starts]
    )
    for step in (advance_batch, lambda system, *at: batch_step(system)(*at)):
        found = step(system, starts.T, np.zeros((0, 2)), np.zeros((2, 2)), dt)
        np.testing.assert_allclose(found.T, expected, rtol=1e-4, atol=1e-5)
    for step in (advance, lambda system, *at: single_step(system)(*at)):
        found = [step(system, x0, [], [0.0, 0.0], dt) for x0 in starts.tolist()]
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("system", [Lorenz(), Pendulum(), TwoInputs()], ids=lambda s: s.name)
def test_inputs_and_noise(system):
    rng, n, steps = np.random.default_rng(5), 2, 20
    x0 = rng.uniform(*system.box(), (n, system.nx))
    u = rng.uniform(-1, 1, (steps, n, system.nu)) * system.u_max
    w = rng.uniform(-0.1, 0.1, (steps, n, system.nx))
    x = simulate(system, x0, steps, 0.05, u, w)
    for row in range(n):
        state = x0[row]
        for uk, wk in zip(u[:, row], w[:, row], strict=True):

            def field(t, x, uk=uk, wk=wk):
                return system.f(x) + np.array(system.g(x.tolist())) @ uk + wk

            state = solve_ivp(field, (0, 0.05), state, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        assert np.allclose(x[-1, row], state, rtol=1e-5, atol=1e-7)


def test_no_starts_no_steps_and_signals_that_are_left_out():
    assert simulate(Lorenz(), np.empty((0, 3)), 2, DT).shape == (3, 0, 3)
    x0 = np.random.default_rng(6).uniform(-30, 30, (5, 3))
    kept = x0.copy()
    assert np.array_equal(simulate(Lorenz(), x0, 0, DT), x0[None])
    zero = simulate(Lorenz(), x0, 10, DT, np.zeros((10, 5, 1)), np.zeros((10, 5, 3)))
    assert np.array_equal(simulate(Lorenz(), x0, 10, DT), zero)
    assert np.array_equal(zero[0], kept)
    assert np.array_equal(x0, kept)


@pytest.mark.parametrize(("wrong", "match"), [
    ({"x0": np.zeros(3)}, r"x0 .* \(n, 3\)"), ({"x0": [[0.0, math.nan, 0.0]]}, "x0 must be finite"),
    ({"u": np.zeros((5, 2))}, r"u must have shape \(5, 2, 1\), got \(5, 2\)"), ({"dt": 0.0}, "dt must be"),
    ({"w": np.zeros((5, 2, 1))}, r"w must have shape \(5, 2, 3\)"),
])  # fmt: skip
def test_wrong_arguments_raise(wrong, match):
    arguments = {"x0": np.zeros((2, 3)), "steps": 5, "dt": DT, **wrong}
    with pytest.raises(ValueError, match=match):
        simulate(Lorenz(), **arguments)


def test_a_reactor_that_its_input_makes_fast_is_resolved():
    """In closed form, x tends to u / (u + 0.02) at the rate u + 0.02."""
    system, dt, x0 = Flushed(), 1.0, 0.2
    for u in (0.8, 4.0, 40.0, 400.0):
        end = u / (u + 0.02)
        expected = end + (x0 - end) * math.exp(-(u + 0.02) * dt)
        for step in (single_step(system), functools.partial(advance, system)):
            assert step((x0,), [u], [0.0], dt)[0] == pytest.approx(expected, rel=1e-6)
        for step in (batch_step(system), functools.partial(advance_batch, system)):
            found = step(np.full((1, 3), x0), np.full((1, 3), u), np.zeros((1, 3)), dt)
            np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert Flushed().typical_rate == pytest.approx(400.02, rel=1e-6)  # sets the default dt


def test_a_compiled_step_may_take_the_steps():
    pytest.importorskip("numba")
    system, rng = Lorenz(), np.random.default_rng(0)
    x0, u = system.draw_starts(rng, 50, 2.0), rng.uniform(-10, 10, (40, 50, 1))
    x0[:5] *= 100.0  # these rows diverge
    compiled, in_numpy = (simulate(system, x0, 40, DT, u=u, step=step) for step in (batch_step(system), None))
    assert np.isnan(compiled[-1]).any(1).sum() == np.isnan(in_numpy[-1]).any(1).sum() > 0
    np.testing.assert_allclose(compiled, in_numpy, rtol=1e-8)
    steady = simulate(system, x0, 40, DT, u=u, step=lambda x, u, w, dt: x)
    assert (steady[:, 5:] == x0[5:]).all()


def test_huge_steps_of_a_batch_are_refused():
    x, none = np.ones((2, 1)), np.zeros((2, 1))
    with pytest.raises(SubstepsError, match=r"dt = 1e\+06 s of two_inputs; .* at x = \[.*take a smaller dt"):
        advance_batch(TwoInputs(), x, none, none, 1e6)
