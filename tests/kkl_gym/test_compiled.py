import logging
import math
import sys
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from kinked_systems import SYSTEMS as KINKED

import kkl_gym
from kkl_gym import SYSTEMS, EquationError, System, get_system
from kkl_gym.compiled import batch_step
from kkl_gym.compiled.batch import compiled_step
from kkl_gym.elementary import cos, sin, tanh
from kkl_gym.simulate import advance, advance_batch

DT = 0.01
compiles = pytest.mark.usefixtures("compiler")


@pytest.fixture
def compiler():
    for library in ("numba", "sympy"):
        pytest.importorskip(library)


@dataclass(frozen=True)
class Unicycle(System):
    """Inputs through a matrix that depends on the state, two outputs, a numerical rate."""

    slip: float = 0.3

    name = "unicycle"
    X = ((-1, 1), (-1, 1), (-3, 3))
    bounds = ((-10, 10), (-10, 10), (-30, 30))
    u_max = (2.0, 3.0)

    def f(self, x):
        return self.slip * tanh(x[1]), -self.slip * x[0] ** 3, 0.0 * x[2]

    def g(self, x):
        return (cos(x[2]), 0.0), (sin(x[2]), 0.0), (0.0, 1.0)

    def h(self, x):
        return x[0], x[1]


class Branching(Unicycle):
    """Equations that single states and symbols cannot share."""

    name = "branching"

    def f(self, x):
        return np.where(x[1] > 0, x[1], 0.0), -x[0], 0.0 * x[2]


@dataclass(frozen=True)
class Autonomous(System):
    name = "autonomous"
    X = ((0.5, 1),)
    bounds = ((-5, 5),)

    def f(self, x):
        return (1.0 / (x[0] - 1.0),)

    def h(self, x):
        return (x[0],)

    def rate(self, x):
        return 1.0


systems = pytest.mark.parametrize("system", [*(get_system(name) for name in SYSTEMS), Unicycle()])


def batch(system, n=200, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(*system.box(2), (n, system.nx)).T
    return x, rng.uniform(-1, 1, (system.nu, n)), rng.uniform(-1, 1, x.shape)


@compiles
@systems
def test_the_systems_compile(system):
    assert batch_step(system).obstacle is None
    assert kkl_gym.KKLVectorEnv(system, 2).compiled


@compiles
@systems
@pytest.mark.parametrize("dt", [DT, 0.2])
def test_compiled_is_numpys_step(system, dt):
    x, u, w = batch(system)
    before = x.copy()
    expected = advance_batch(system, x, u, w, dt)
    got = compiled_step(system)(x, u, w, dt)
    assert got.flags.c_contiguous
    assert (x == before).all()
    assert np.allclose(got, expected, rtol=1e-11, atol=1e-11, equal_nan=True)


@compiles
@pytest.mark.parametrize("system", KINKED, ids=str)
def test_kinks_and_jumps_are_the_same_on_floats_arrays_and_compiled(system):
    assert kkl_gym.KKLVectorEnv(system, 2).compiled
    step = batch_step(system)
    x, u, w = batch(system)
    kinks = np.array([-1.5, -1.0, -0.5, 0.0, 0.3, 1.0, 1.5])
    x[0, :7], x[1, 7:14] = kinks, kinks  # where the equations of either change
    for dt in (DT, 0.2):
        expected = advance_batch(system, x, u, w, dt)
        single = [advance(system, tuple(xi), list(ui), list(wi), dt) for xi, ui, wi in zip(x.T, u.T, w.T, strict=True)]
        assert np.isfinite(expected).all()
        assert np.allclose(np.array(single).T, expected, rtol=1e-12, atol=1e-12)
        assert np.allclose(step(x, u, w, dt), expected, rtol=1e-12, atol=1e-12)


def test_any_memory_layout_and_no_rows():
    system = Unicycle()
    x, u, w = batch(system, 5)
    expected = batch_step(system)(x, u, w, DT)
    assert (batch_step(system)(*map(np.asfortranarray, (x, u, w)), DT) == expected).all()
    some = batch_step(system)(x[:, ::2], u[:, ::2], w[:, ::2], DT)
    assert np.allclose(some, expected[:, ::2], rtol=1e-13, atol=1e-13)
    assert batch_step(system)(x[:, :0], u[:, :0], w[:, :0], DT).shape == (3, 0)


@systems
def test_lost_rows_are_nan_without_warning_and_leave_the_others(system):
    x, u, w = batch(system, 4)
    expected = batch_step(system)(x, u, w, DT)
    for wild in (math.nan, math.inf, 1e200):
        x[:, 1] = wild
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            got = batch_step(system)(x, u, w, DT)
        assert not np.isfinite(got[:, 1]).all()
        assert np.allclose(got[:, [0, 2, 3]], expected[:, [0, 2, 3]], rtol=1e-13, atol=1e-13)


@compiles
def test_division_by_zero_and_no_inputs():
    got = compiled_step(Autonomous())(np.array([[1.0, 0.5]]), np.zeros((0, 2)), np.zeros((1, 2)), DT)
    assert not np.isfinite(got[0, 0])
    assert got[0, 1] == pytest.approx(advance_batch(Autonomous(), np.array([[0.5]]), [], np.zeros((1, 1)), DT)[0, 0])


def test_parameters_are_the_systems_own():
    x, u, w = batch(Unicycle(), 3)
    fast, slow = (batch_step(Unicycle(slip))(x, u, w, DT) for slip in (3.0, 0.0))
    assert not np.allclose(fast, slow)


@compiles
def test_numpy_where_equations_cannot_be_compiled(caplog):
    """And somebody who asks is told so, and why."""
    with pytest.raises(EquationError, match=r"use kkl_gym\.elementary\.where") as raised:
        compiled_step(Branching())
    with caplog.at_level(logging.INFO, "kkl_gym"):
        step = batch_step(Branching(slip=0.31))
    assert step.obstacle == f"EquationError: {raised.value}"
    assert [record.getMessage() for record in caplog.records] == [
        f"branching goes on with NumPy, not compiled: {step.obstacle}"
    ]
    assert not kkl_gym.KKLVectorEnv(Branching(slip=0.31), 2).compiled
    assert len(caplog.records) == 1  # once for each system
    x, u, w = batch(Branching(), 3)
    assert (step(x, u, w, DT) == advance_batch(Branching(), x, u, w, DT)).all()


@compiles
@pytest.mark.parametrize(("unit", "second"), [(1.0, 1.0), (1e-12, 1.0), (1.0, 1e-9)])
def test_equations_that_mean_something_else_to_symbols(unit, second):
    class Comparing(Unicycle):
        name = "comparing"
        X = ((-unit, unit),) * 3
        bounds = ((-9 * unit, 9 * unit),) * 3

        def f(self, x):
            still = x[0] == 1.0 * x[0]  # true for numbers; sympy compares how it is written
            return ((0.0 if np.all(still) else unit) + x[1]) / second, x[0] / second, x[2] / second

    with pytest.raises(ValueError, match="symbols"):
        compiled_step(Comparing())
    assert "symbols" in batch_step(Comparing()).obstacle


class Filled(Unicycle):
    """sin(x)/x with its limit at zero, where symbols see no special case."""

    name = "filled"

    def f(self, x):
        return np.where(np.equal(x[0], 0), 1.0, sin(x[0]) / (x[0] + 1.0 * np.equal(x[0], 0))), x[0], x[2]


class Rooted(Unicycle):
    """Not a number for negative states, unless somebody simplifies."""

    name = "rooted"

    def f(self, x):
        return x[0] ** 0.5 * x[0] ** 0.5, x[1], x[2]


class Random(Unicycle):
    name = "random"

    def f(self, x):
        return np.random.default_rng().random() + x[0], x[1], x[2]


class Long(Unicycle):
    name = "long"

    def f(self, x):
        return sum(sin(i + x[0]) * x[1] for i in range(200)), x[1], x[2]


@compiles
@pytest.mark.parametrize(
    ("kind", "obstacle"),
    [(Filled, "elementary"), (Rooted, "symbols"), (Random, "not the same"), (Long, "too long")],
)
def test_equations_better_left_to_numpy(kind, obstacle):
    assert obstacle in batch_step(kind()).obstacle


@dataclass(frozen=True)
class Pole(System):
    """Negative powers, which Numba raises at zero whatever it is told."""

    name = "pole"
    X = ((0.5, 1),)
    bounds = ((-5, 5),)

    def f(self, x):
        return (1e-3 * x[0] ** -2,)

    def rate(self, x):
        return 1.0 + 0.0 * x[0]

    def h(self, x):
        return (x[0],)


def test_negative_powers_at_zero_lose_their_row_only():
    got = batch_step(Pole())(np.array([[0.0, 0.5]]), np.zeros((0, 2)), np.zeros((1, 2)), DT)
    assert not np.isfinite(got[0, 0])
    assert got[0, 1] == pytest.approx(0.5 + 1e-5 / 0.25, rel=1e-3)


def test_systems_that_count_as_equal_are_told_apart():
    @dataclass(frozen=True, eq=False)
    class Decaying(System):
        a: float

        name = "decaying"
        X = ((0.5, 1),)
        bounds = ((-5, 5),)

        def f(self, x):
            return (-self.a * x[0],)

        def h(self, x):
            return (x[0],)

    x = np.ones((1, 1))
    steps = [batch_step(Decaying(a))(x, np.zeros((0, 1)), np.zeros((1, 1)), 0.1)[0, 0] for a in (1.0, 5.0)]
    assert steps == pytest.approx([np.exp(-0.1), np.exp(-0.5)], rel=1e-5)


@compiles
@pytest.mark.parametrize(("missing", "slip"), [("numba", 0.123), ("sympy", 0.124)])
def test_numpy_where_a_library_is_missing(monkeypatch, missing, slip):
    monkeypatch.setitem(sys.modules, missing, None)
    assert missing in batch_step(Unicycle(slip)).obstacle
