import copy
import functools
import logging
import math
import pickle
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from kinked_systems import SYSTEMS as KINKED

import kkl_gym.compiled.step
from kkl_gym import SYSTEMS, EquationError, KKLEnv, KKLVectorEnv, System, get_system
from kkl_gym.compiled import batch_step, single_step
from kkl_gym.elementary import clip, cos, exp, log, maximum, minimum, sign, sin, sqrt, tan, tanh, where
from kkl_gym.simulate import advance, advance_batch
from observers.thresholds import SOON

GRAVITY = 9.81


@pytest.fixture(autouse=True)
def compiler():
    pytest.importorskip("numba")


@dataclass(frozen=True)
class Pendulum(System):
    """Two inputs, one through a matrix that depends on the state; numbers of class and module; a numerical rate."""

    damping: float = 0.1

    length = 2
    name = "pendulum"
    X = ((-3, 3), (-3, 3))
    bounds = ((-30, 30), (-30, 30))
    u_max = (2, 3)

    def f(self, x):
        angle, speed = x
        return speed, -GRAVITY / self.length * sin(angle) - self.damping * speed * abs(speed)

    def g(self, x):
        return (0.0, 0.1), (cos(x[0]), 0.0)

    def h(self, x):
        return (x[0],)


class TwoInputs(Pendulum):
    """The same with a constant input matrix."""

    name = "two_inputs"
    G = ((0.0, 0.1), (1.0, 0.7))
    g = System.g


@dataclass(frozen=True)
class Elementary(System):
    """All there is in kkl_gym.elementary, and branches."""

    name = "elementary"
    X = ((-2, 2), (0.5, 3), (-1, 1))
    bounds = ((-5, 5), (-5, 5), (-5, 5))

    def f(self, x):
        a, b, c = x
        if c > 0.2:
            a = a + 0.1 * c
        return (
            tanh(b) * where(a > b, c, 1) - clip(a, -1, 1),
            exp(-abs(b)) - log(1.0 + a * a) + maximum(a, c) / 3 - 0.3 * tan(0.1 * c),
            sqrt(abs(a)) - sign(c) * minimum(b, 1.0),
        )

    def h(self, x):
        return (x[0],)


def starts(system, n, factor=2.0, seed=7):
    rng = np.random.default_rng(seed)
    scale = np.array(system.scale)
    for x in rng.uniform(*system.box(factor), (n, system.nx)):
        u = (np.array(system.u_max) * rng.uniform(-1, 1, system.nu)).tolist()
        yield tuple(x.tolist()), u, (scale * rng.uniform(-1, 1, system.nx)).tolist()


@pytest.mark.parametrize(
    "system", [*map(get_system, SYSTEMS), Pendulum(), TwoInputs(0.3), Elementary(), *KINKED], ids=lambda s: s.name
)
@pytest.mark.parametrize("dt", [0.01, 0.13])
def test_it_is_pythons_step_to_the_last_bit(system, dt):
    step = single_step(system).advance
    for at in starts(system, 500):
        expected = advance(system, *at, dt)
        assert np.array_equal(step(*at, dt), expected, equal_nan=True), at


@pytest.mark.parametrize("name", SYSTEMS)
def test_parameters_are_the_systems_own(name):
    system = get_system(name)
    changed = system.replace({key: 1.1 * value for key, value in system.parameters.items()})
    step = single_step(changed).advance
    for at in starts(system, 100):
        assert tuple(step(*at, 0.01)) == tuple(advance(changed, *at, 0.01))


@pytest.mark.parametrize("wild", [math.inf, math.nan, 1e200, -1e7])
@pytest.mark.parametrize("name", SYSTEMS)
def test_wild_states_end_as_in_python(name, wild):
    system = get_system(name)
    x, u, w = (1.0,) * (system.nx - 1) + (wild,), [0.0] * system.nu, [0.0] * system.nx
    step = single_step(system).advance
    assert np.array_equal(step(x, u, w, 0.01), advance(system, x, u, w, 0.01), equal_nan=True)


class Powers(Elementary):
    name = "powers"

    def f(self, x):
        return x[0] ** 3, x[1], x[2]


class Generators(Elementary):
    name = "generators"

    def f(self, x):
        return tuple(-xi for xi in x)


class Calls(Elementary):
    name = "calls"

    def f(self, x):
        return self.helper(x), 0.0, 0.0

    def helper(self, x):
        return -x[0]


TUPLE, MODULE = (1.0, 2.0), np


class CallsOthers(Elementary):
    name = "calls_others"

    def f(self, x):
        return falling(x[0]), -x[1], -x[2]


def falling(x):
    return -TUPLE[0] * x


TABLE = {"k": 1.0}


class FromTable(Elementary):
    name = "from_table"

    def f(self, x):
        return -TABLE["k"] * x[0], -x[1], -x[2]


class Tuples(Elementary):
    name = "tuples"

    def f(self, x):
        return -TUPLE[0] * x[0], -x[1], -x[2]


class NumPys(Elementary):
    name = "numpys"

    def f(self, x):
        return -MODULE.sin(x[0]), -x[1], -x[2]


class Long(Elementary):
    name = "long"
    exec(f"def f(self, x):\n    return {' + '.join(['sin(x[0])'] * 200)}, -x[1], -x[2]")


class Properties(Elementary):
    name = "properties"
    stiffness = property(lambda self: 2.0)

    def f(self, x):
        return -self.stiffness * x[0], -x[1], -x[2]


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        (Powers, "f has a power; products"),
        (Generators, "f makes functions"),
        (Calls, "f reads helper"),
        (Tuples, "f uses TUPLE"),
        (NumPys, "f uses MODULE"),
        (Long, "f is too long"),
        (Properties, "f reads stiffness"),
    ],
)
def test_what_cannot_be_compiled_stays_in_python_and_the_log_says_why(kind, why, caplog):
    with caplog.at_level(logging.INFO, "kkl_gym"):
        assert why in single_step(kind()).obstacle
        assert single_step(kind()).obstacle
    (record,) = [record for record in caplog.records if record.name == "kkl_gym"]
    assert record.getMessage().startswith(f"single steps of {kind.name} stay in Python: ")


@pytest.mark.parametrize("step_of", [single_step, batch_step])
@pytest.mark.parametrize(
    ("where", "name", "value"),
    [
        (Pendulum, "length", 3),
        (Pendulum, "X", ((-1.0, 1.0), (-0.5, 0.5))),
        (sys.modules[__name__], "GRAVITY", 3.7),
    ],
)
def test_what_the_equations_read_is_looked_up_anew(step_of, where, name, value, monkeypatch):
    before = step_of(Pendulum())
    assert before.obstacle is None
    again = step_of(Pendulum())
    assert again is before or again.advance.kernel is before.advance.kernel
    monkeypatch.setattr(where, name, value)
    after = step_of(Pendulum())
    assert after is not before
    x, u, w = ([[0.3], [0.4]], [[0.5], [0.2]], [[0.0], [0.0]])
    if step_of is batch_step:
        found = after(*(np.array(values) for values in (x, u, w)), 0.01)
        np.testing.assert_allclose(found, advance_batch(Pendulum(), *map(np.array, (x, u, w)), 0.01), rtol=1e-12)
    else:
        single = [tuple(value for (value,) in values) for values in (x, u, w)]
        assert tuple(after(*single, 0.01)) == tuple(advance(Pendulum(), *single, 0.01))


@pytest.mark.parametrize("system", [CallsOthers(), FromTable()])
def test_what_a_batchs_equations_say_is_compared_anew(system, monkeypatch):
    assert batch_step(system).obstacle is None
    monkeypatch.setattr(sys.modules[__name__], "TUPLE", (4.0, 0.5))
    monkeypatch.setitem(TABLE, "k", 3.0)
    x, u, w = np.array([[0.3], [0.6], [0.1]]), np.zeros((0, 1)), np.zeros((3, 1))
    np.testing.assert_allclose(batch_step(system)(x, u, w, 0.01), advance_batch(system, x, u, w, 0.01), rtol=1e-12)


def test_without_numba_it_stays_in_python(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    kkl_gym.compiled.step._kept.clear()
    assert single_step(get_system("lorenz")).obstacle.startswith("ModuleNotFoundError")
    kkl_gym.compiled.step._kept.clear()


def episode(env, seed, steps, gain=0.5):
    obs, info = env.reset(seed=seed)
    found = [(obs, info["x"], info["y"])]
    for k in range(steps):
        obs, reward, terminated, _, info = env.step(np.full(env.action_space.shape, gain * math.sin(0.01 * k)))
        found.append((obs, info["x"], info["y"], info["u"], reward, terminated))
        if terminated:
            break
    return found


def in_python(env):
    return isinstance(env._advance, functools.partial)


def same(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        assert all(np.array_equal(p, q) for p, q in zip(a, b, strict=True))


@pytest.mark.parametrize("system", [*SYSTEMS, Pendulum()], ids=str)
def test_episodes_are_the_same_with_it_and_without(system):
    env = KKLEnv(system)
    before = episode(env, 3, SOON + 500)
    assert in_python(env)
    after = episode(env, 3, SOON + 500)
    assert not in_python(env)
    same(before, after)


def test_it_waits_for_a_reset_after_many_steps():
    env = KKLEnv("lorenz")
    episode(env, 0, SOON // 2)
    episode(env, 0, SOON // 2 - 1)
    episode(env, 0, 3)
    assert in_python(env)
    env.reset(seed=0)
    assert not in_python(env)


def test_copies_go_on_as_the_original():
    env = KKLEnv("lorenz", measurement_noise=0.0)
    episode(env, 0, SOON)
    episode(env, 0, 10)
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    expected = env.step([0.3])
    for twin in twins:
        for a, b in zip(twin.step([0.3])[:4], expected[:4], strict=True):
            assert np.array_equal(a, b)


def test_numbers_of_the_module_and_of_the_class_are_taken_as_they_are_at_the_reset(monkeypatch):
    system = Pendulum()
    at = (1.0, 0.0), [0.0, 0.0], [0.0, 0.0]
    single_step(system)
    monkeypatch.setattr(sys.modules[__name__], "GRAVITY", 1.62)
    assert tuple(single_step(system).advance(*at, 0.1)) == tuple(advance(system, *at, 0.1))
    monkeypatch.setattr(Pendulum, "length", 1)
    assert tuple(single_step(system).advance(*at, 0.1)) == tuple(advance(system, *at, 0.1))


class Singular(Elementary):
    """Python raises where x1 = 0 and the motion ends there; an infinite number would go on as a finite one."""

    name = "singular"

    def f(self, x):
        return x[1] - 1.0 / (1.0 + 1.0 / abs(x[0])), where(abs(x[0]) > 1e-9, sin(x[0]) / x[0], 1.0), -x[2]


@pytest.mark.parametrize("x0", [(0.0, 0.0, 0.0), (1e-3, 1.0, 0.0)])
def test_divisions_by_zero_end_as_in_python(x0):
    at = x0, [], [0.0] * 3
    step = single_step(Singular())
    assert step.obstacle is None
    assert np.array_equal(step.advance(*at, 0.01), advance(Singular(), *at, 0.01), equal_nan=True)


def test_an_environment_that_is_given_another_system_takes_its_equations():
    one, other = (KKLEnv("lorenz", parameters={"rho": rho}) for rho in (28.0, 20.0))
    episode(one, 0, SOON)
    one.reset(seed=1, options={"x0": [1.0, 2.0, 20.0]})
    other.reset(seed=1, options={"x0": [1.0, 2.0, 20.0]})
    one.system = other.system
    (_, reward, *_, info), (_, expected, *_, there) = one.step([0.3]), other.step([0.3])
    assert (info["x"] == there["x"]).all()
    assert reward == expected  # at the other's target
    with pytest.raises(ValueError, match="exchanged for another 'lorenz', got Rossler"):
        one.system = get_system("rossler")
    with pytest.raises(EquationError):  # which has no such target
        one.system = get_system("lorenz").replace({"rho": 0.5})
    assert one.system is other.system
    for name in ("dt", "measurement_noise", "process_noise"):
        with pytest.raises(AttributeError):
            setattr(one, name, 0.1)


def test_systems_that_stay_for_an_episode_are_not_compiled():
    env = KKLEnv("lorenz")
    for rho in (26.0, 27.0):
        env.system = env.system.replace({"rho": rho})
        episode(env, 0, SOON)
        assert in_python(env)
    episode(env, 0, 3)
    assert not in_python(env)  # it has stayed


def test_a_vector_that_is_given_another_system_takes_its_equations():
    one, other = (KKLVectorEnv("lorenz", 200, parameters={"rho": rho}) for rho in (28.0, 20.0))
    for env in (one, other):
        env.reset(seed=1, options={"x0": [1.0, 2.0, 20.0]})
    assert one.compiled
    one.system = other.system
    (_, reward, *_, info), (_, expected, *_, there) = (env.step(np.full((200, 1), 0.3)) for env in (one, other))
    np.testing.assert_array_equal(info["x"], there["x"])
    np.testing.assert_array_equal(reward, expected)


def test_a_method_that_is_replaced_is_compiled_anew(monkeypatch):
    class Falling(Elementary):
        name = "falling"

        def f(self, x):
            return -x[0], -x[1], -x[2]

    at = (1.0, 2.0, 0.5), [], [0.0] * 3
    before = single_step(Falling()).advance(*at, 0.1)
    monkeypatch.setattr(Falling, "f", lambda self, x: (-2.0 * x[0], -x[1], -x[2]))
    after = single_step(Falling()).advance(*at, 0.1)
    assert after[0] < before[0]
    assert tuple(after) == tuple(advance(Falling(), *at, 0.1))
