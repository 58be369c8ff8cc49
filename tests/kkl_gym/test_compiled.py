"""Compiled steps over a sampling interval, for single states and batches, against Python and NumPy."""

import copy
import logging
import math
import pickle
import sys
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from kinked_systems import SYSTEMS as KINKED
from pushed_systems import Pendulum, TwoInputs

from kkl_gym import SYSTEMS, EquationError, KKLEnv, KKLVectorEnv, System, get_system
from kkl_gym.compiled import batch_step, single_step
from kkl_gym.elementary import clip, exp, log, maximum, minimum, sign, sin, sqrt, tan, tanh, where
from kkl_gym.envs import SOON
from kkl_gym.simulate import advance, advance_batch

DT = 0.01
GRAVITY = 9.81
TABLE = {"k": 2.0}
SHIPPED = [get_system(name) for name in SYSTEMS]


@pytest.fixture(autouse=True)
def compiler():
    pytest.importorskip("numba")


@dataclass(frozen=True)
class Elementary(System):
    """All functions in kkl_gym.elementary."""

    name = "elementary"
    X = ((-2, 2), (0.5, 3), (-1, 1))
    bounds = ((-5, 5), (-5, 5), (-5, 5))

    def f(self, x):
        a, b, c = x
        a = where((c > 0.2) | (b == 1.0), a + 0.1 * c, a)
        return (
            tanh(b) * where(a > b, c, 1) - clip(a, -1, 1) + 1.0 / (1.0 + 1.0 / abs(x[0])),  # Python raises at 0
            exp(-abs(b)) - log(1.0 + a * a) + maximum(a, c) / 3 - 0.3 * tan(0.1 * c),
            sqrt(abs(a)) - sign(c) * minimum(b, 1.0),
        )

    def h(self, x):
        return (x[0],)


@dataclass(frozen=True, eq=False)
class Decaying(System):
    """A single state that compiles fast; `==` compares neither two of these systems nor their parameters."""

    a: float = 1.0

    factor = 1.0
    name = "decaying"
    X = ((0.5, 1),)
    bounds = ((-5, 5),)

    def f(self, x):
        return (-self.a * self.factor * GRAVITY * x[0],)

    def h(self, x):
        return (x[0],)

    def rate(self, x):
        return 20.0


def variant(f, name="variant", of=Decaying, **variables):
    return type("Variant", (of,), {"name": name, "f": f, **variables})()


def points(system, n=200, seed=0, factor=2.0):
    """Random states, inputs and process noise."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(*system.box(factor), (n, system.nx)).T
    u_max, scale = np.array(system.u_max)[:, None], np.array(system.scale)[:, None]
    return x, u_max * rng.uniform(-1, 1, (system.nu, n)), scale * rng.uniform(-1, 1, x.shape)


def rows(*arrays):
    return zip(*(map(tuple, array.T.tolist()) for array in arrays), strict=True)


def moved(step_of, system, dt=DT):
    """The next states of a few points, by a compiled step, and by Python or NumPy."""
    x, u, w = points(system, 5)
    if step_of is batch_step:
        return batch_step(system)(x, u, w, dt), advance_batch(system, x, u, w, dt)
    return [[step(*at, dt) for at in rows(x, u, w)] for step in (single_step(system), lambda *at: advance(system, *at))]


@pytest.mark.parametrize("system", [*SHIPPED, TwoInputs(), KINKED[1]], ids=lambda s: s.name)
def test_a_batchs_step_is_numpys(system):
    assert KKLVectorEnv(system, 2).compiled
    step = batch_step(system)
    x, u, w = points(system)
    kinks = np.array([-1.5, -1.0, -0.5, 0.0, 0.3, 1.0, 1.5])
    x[0, :7], x[1, 7:14] = kinks, kinks  # the kinks of KINKED[1]
    for dt in (DT, 0.2):
        before, got = x.copy(), step(x, u, w, dt)
        assert got.flags.c_contiguous
        assert (x == before).all()
        assert np.allclose(got, advance_batch(system, x, u, w, dt), rtol=1e-11, atol=1e-11, equal_nan=True)
    for wild in (math.nan, math.inf, 1e200):  # makes only its own row NaN
        lost = x.copy()
        lost[:, 1] = wild
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = step(lost, u, w, dt)
        assert not np.isfinite(found[:, 1]).all()
        assert np.allclose(np.delete(found, 1, 1), np.delete(got, 1, 1), rtol=1e-13, atol=1e-13, equal_nan=True)
    layout = step(*(np.asfortranarray(values)[:, ::2] for values in (x, u, w)), dt)
    assert np.allclose(layout, got[:, ::2], rtol=1e-13, atol=1e-13, equal_nan=True)
    assert step(x[:, :0], u[:, :0], w[:, :0], dt).shape == (system.nx, 0)


@pytest.mark.parametrize("system", [*SHIPPED[1::2], Pendulum(), TwoInputs(0.3), Elementary()], ids=lambda s: s.name)
def test_a_single_step_is_pythons_to_the_last_bit(system):
    assert single_step(system).obstacle is None
    step = single_step(system).advance
    for dt, n in ((DT, 300), (0.13, 100)):
        for at in rows(*points(system, n, seed=7)):
            assert np.array_equal(step(*at, dt), advance(system, *at, dt), equal_nan=True), at
    for wild in (0.0, math.inf, math.nan, 1e200, -1e7):
        at = (wild,) + (1.0,) * (system.nx - 1), [0.0] * system.nu, [0.0] * system.nx
        assert np.array_equal(step(*at, DT), advance(system, *at, DT), equal_nan=True), wild


@pytest.mark.parametrize("pole", [(1.0, 0.5), (0.5, 0.0)])
def test_a_division_by_zero_makes_its_own_row_nan_only(pole):
    """Also for a negative power of zero, at which Numba raises an error in every error model."""
    box = {"X": ((0.5, 1), (0.5, 1)), "bounds": ((-5, 5), (-5, 5)), "rate": lambda self, x: 1.0}
    system, x = variant(lambda self, x: (1.0 / (x[0] - 1.0), 1e-3 * x[1] ** -2), **box), np.array([pole, (0.5, 0.5)]).T
    assert batch_step(system).obstacle is None
    got = batch_step(system)(x, np.zeros((0, 2)), np.zeros((2, 2)), DT)
    assert not np.isfinite(got[:, 0]).all()
    assert got[:, 1] == pytest.approx(advance(system, (0.5, 0.5), [], [0.0] * 2, DT))


def compared(unit, second):
    """Equations that treat symbols differently from numbers, by checking the type of the state."""

    def f(self, x):
        return (((0.0 if isinstance(x[0], float | np.ndarray) else unit) + x[0]) / second,)

    return variant(f, X=((-unit, unit),), bounds=((-9 * unit, 9 * unit),), rate=lambda self, x: 1.0 / second)


@pytest.mark.parametrize(("step_of", "system", "why"), [
    (batch_step, compared(1e-12, 1.0), "symbols"),
    (batch_step, compared(1.0, 1e-9), "symbols"),
    (batch_step, variant(lambda self, x: (np.where(x[0] > 0, x[0], 0.0),)), "use kkl_gym.elementary.where"),
    (batch_step, variant(lambda self, x: (np.random.default_rng().random() + x[0],)), "differ from one call"),
    (batch_step, variant(lambda self, x: (sum(sin(i + x[0]) * x[0] for i in range(200)),)), "500 operations"),
    (single_step, variant(lambda self, x: (x[0] ** 3,)), "there is a power or a remainder"),
    (single_step, variant(lambda self, x: (math.sin(x[0]),)), "use kkl_gym.elementary.sin"),
])  # fmt: skip
def test_equations_that_do_not_compile_run_in_python_and_the_log_gives_the_reason_once(step_of, system, why, caplog):
    with caplog.at_level(logging.INFO, "kkl_gym"):
        assert why in step_of(system).obstacle
        assert step_of(system).obstacle
    (record,) = caplog.records
    assert why in record.getMessage()
    if "where" in why:
        assert not KKLVectorEnv(system, 2).compiled
        np.testing.assert_array_equal(*moved(batch_step, system))


class Chain(Decaying):
    """Equations with loops, helpers, a table and arrays; the traced program contains only arithmetic."""

    name, X, bounds = "chain", ((-1, 1),) * 3, ((-9, 9),) * 3

    def pull(self, x, i):
        return TABLE["k"] * (x[i - 1] - x[i])

    def f(self, x):
        return np.array([self.pull(x, i) - np.float64(0.5) * x[i] for i in range(len(x))])


@pytest.mark.parametrize("step_of", [single_step, batch_step])
def test_traced_programs_equal_equations_with_loops_and_arrays(step_of):
    assert step_of(Chain()).obstacle is None
    np.testing.assert_allclose(*moved(step_of, Chain()), rtol=1e-12)


@pytest.mark.parametrize("power", [2, 3, -2, 0.5, 1.5, np.float64(2.0)])
def test_powers_in_batches(power):
    system = variant(lambda self, x: (0.1 * x[0] ** power - 2.0 ** -x[0] + x[0] % 0.3,))
    assert batch_step(system).obstacle is None
    np.testing.assert_allclose(*moved(batch_step, system), rtol=1e-11)


@pytest.mark.parametrize("system", [*SHIPPED, TwoInputs()], ids=lambda s: s.name)
def test_rows_of_a_batch_are_single_steps_to_the_last_bit(system):
    x, u, w = points(system, 50)
    alone = [single_step(system)(*at, DT) for at in rows(x, u, w)]
    assert np.array_equal(batch_step(system)(x, u, w, DT).T, alone)


@pytest.mark.parametrize("step_of", [batch_step, single_step])
def test_without_numba(step_of, monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    assert "import of numba" in step_of(variant(lambda self, x: (-x[0],), name="without_numba")).obstacle


HERE = sys.modules[__name__]
CHANGES = [
    (Decaying, "factor", 3),
    (Decaying, "f", lambda self, x: (-2.0 * x[0],)),
    (HERE, "GRAVITY", 3.7),
]


@pytest.mark.parametrize(("where", "name", "value"), CHANGES)
def test_changed_globals_and_attributes_of_equations_recompile(where, name, value, monkeypatch):
    before, _ = moved(single_step, Decaying())
    monkeypatch.setattr(where, name, value)
    after, expected = moved(single_step, Decaying())
    np.testing.assert_allclose(after, expected, rtol=1e-12)
    assert not np.allclose(after, before)


def episode(env, seed, steps, gain=0.5):
    obs, info = env.reset(seed=seed)
    found = [(obs, info["x"], info["y"])]
    for k in range(steps):
        obs, reward, terminated, _, info = env.step(np.full(env.action_space.shape, gain * math.sin(0.01 * k)))
        found.append((obs, info["x"], info["y"], info["u"], reward, terminated))
        if terminated:
            break
    return found


@pytest.mark.parametrize("system", ["lorenz", Pendulum()], ids=str)
def test_episodes_are_the_same_with_and_without_compilation(system):
    env = KKLEnv(system)
    in_python, compiled = (episode(env, 3, SOON + 300) for _ in range(2))
    for a, b in zip(in_python, compiled, strict=True):
        assert all(np.array_equal(p, q) for p, q in zip(a, b, strict=True))
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    action = np.full(env.action_space.shape, 0.3)
    expected = env.step(action)
    for twin in twins:
        assert all(np.array_equal(a, b) for a, b in zip(twin.step(action)[:4], expected[:4], strict=True))


def test_an_environment_that_is_given_another_system_takes_its_equations():
    one, other = (KKLEnv("lorenz", parameters={"rho": rho}) for rho in (28.0, 20.0))
    episode(one, 0, SOON)
    for env in (one, other):
        env.reset(seed=1, options={"x0": [1.0, 2.0, 20.0]})
    one.system = other.system
    (_, reward, *_, info), (_, expected, *_, there) = one.step([0.3]), other.step([0.3])
    assert (info["x"] == there["x"]).all()
    assert reward == expected  # for the other target
    with pytest.raises(ValueError, match="exchanged for another 'lorenz', got Rossler"):
        one.system = get_system("rossler")
    with pytest.raises(EquationError):  # this target does not exist
        one.system = get_system("lorenz").replace({"rho": 0.5})
    assert one.system is other.system
    for name in ("dt", "measurement_noise", "process_noise"):
        with pytest.raises(AttributeError):
            setattr(one, name, 0.1)
