"""Mistakes in a user's equations: each is said with system, equation, file, line and the way out."""

import itertools
import math
import pickle
import re
import textwrap

import numpy as np
import pytest
from wrong_systems import Late, Wide

from kkl_gym import EquationError, KKLEnv, KKLVectorEnv, elementary, get_system
from kkl_gym.compiled import batch_step, single_step
from kkl_gym.simulate import advance, advance_batch

HEAD = """
import math
import numpy as np
from dataclasses import dataclass
from kkl_gym import System, elementary

def friction(v):
    return math.tanh(v)

@dataclass(frozen=True)
class Tank(System):
    k: float = 2.0

    name = "tank"
    X = ((0.5, 1.0), (-2.0, 2.0))
    bounds = ((-9.0, 9.0), (-9.0, 9.0))
    u_max = (1.0,)
    G = ((0.0,), (1.0,))
"""
FROM_F, FROM_H = (
    "must return 2 components, one for each state",
    "must return its components in a sequence, as in (x[0],)",
)
FROM_G = "must return 2 rows, one for each state, of 1 components, one for each input"
FROM_RATE, FINITE = "must return one number in 1/s for each state", "must return finite numbers within X"
ALIKE = "must return for each state of a batch what it returns for that state alone, and always the same"
SERVES = "which serves floats, arrays, tensors and symbols"
NO_IF = "cannot decide: use kkl_gym.elementary.where, minimum, maximum or clip, and combine conditions by & and |"
ARRAYS = "x held arrays of shape (5,)"


@pytest.fixture
def tank(tmp_path):
    """tank(f=..., h=..., more=...) -> path of a script that defines such a system."""
    numbers = itertools.count()

    def write(f="x[1], -self.k * x[0]", h="(x[0],)", more="", head=HEAD):
        path = tmp_path / f"tank{next(numbers)}.py"
        methods = f"def f(self, x):\n    return {f}\n\ndef h(self, x):\n    return {h}\n\n{more}\n"
        path.write_text(head + textwrap.indent(methods, "    "))
        return path

    return write


def line_of(path, text):
    """Number of the last line of a script that holds a text."""
    return max(i for i, line in enumerate(path.read_text().splitlines(), 1) if text in line)


def test_scripts_without_mistake(tank):
    system = get_system(f"{tank()}:Tank")
    assert system.nu == system.ny == 1
    path = tank(f="np.array([x[1], x[0]])", h="[np.where(x[0] > 0, 1.0, 0.0), 1]", more="target = np.zeros(2)")
    system = get_system(f"{path}:Tank")
    assert system.ny == 2
    assert system.target.shape == (2,)


# What stands behind the return of f, and what is said of it.
MOTIONS = [
    ("(x[1] if x[0] > 0 else 0.0), x[0]", ["ValueError", ARRAYS, NO_IF]),
    ("x[1], -math.sin(x[0])", ["TypeError", ARRAYS, f"use kkl_gym.elementary.sin, {SERVES}"]),
    ("x[1], math.sqrt(-x[0])", ["ValueError", "x = (", f"use kkl_gym.elementary.sqrt, {SERVES}"]),
    ("x[1], self.kk * x[0]", ["AttributeError: 'Tank' object has no attribute 'kk'; x = ("]),
    ("x[2], x[0]", ["IndexError", ", 2 of them"]),
]  # fmt: skip


@pytest.mark.parametrize(("f", "said"), MOTIONS)
def test_an_equation_that_raises(tank, f, said):
    path = tank(f=f)
    with pytest.raises(EquationError) as raised:
        get_system(f"{path}:Tank")
    message = str(raised.value)
    assert message.startswith(f"f(x) of 'tank' failed in {path}, line {line_of(path, f)} (`return {f}`): ")
    assert all(text in message for text in said)
    assert raised.value.__cause__ is not None
    assert str(pickle.loads(pickle.dumps(raised.value))) == message  # as from worker processes


# What stands behind the return of f or h, and what is said of it.
RETURNED = [
    ({"f": "x[1]"}, FROM_F, "it returned -"),
    ({"f": "x[1], x[0], 0.0"}, FROM_F, "it returned 3 of them: ("),
    ({"f": "x[0], (-x[0]) ** 0.5"}, FROM_F, "which is complex: take fractional powers of negative numbers by"),
    ({"f": "x[1], 1e400 * x[0]"}, FINITE, ", inf]; x = ("),
    ({"f": "x[1], np.sum(x)"}, ALIKE, "sum, max and norm mix states"),
    ({"h": "x[0]"}, FROM_H, "it returned 0."),
]


@pytest.mark.parametrize(("changes", "wanted", "found"), RETURNED)
def test_an_equation_that_returns_something_else(tank, changes, wanted, found):
    path, (name,) = tank(**changes), changes
    with pytest.raises(EquationError, match=re.escape(found)) as raised:
        get_system(f"{path}:Tank")
    defined = f"{name}(x) of 'tank' ({path}, line {line_of(path, f'def {name}')}) "
    assert str(raised.value).startswith(f"{defined}{wanted}")


# Further definitions in the class, and what is said of them.
DEFINITIONS = [
    ("def f(x):\n return x", ["f(x) of 'tank' (", "must be defined as f(self, x): TypeError: Tank.f() takes 1"]),
    ("def f(self, x):\n return x[1], -friction(x[1])", ["(`return math.tanh(v)`)", "kkl_gym.elementary.tanh"]),
    ("def g(self, x):\n return (0.0,),", [FROM_G, "it returned ((0.0,),)"]),
    ("def rate(self, x):\n return -1.0", [FINITE, ", not below zero; it returned [-1.0]"]),
    ("dt = 0.1\ndef step(self, x, u):\n return x[0], x[1], u[0]", ["step(x, u) of 'tank' (", FROM_F, "3 of them"]),
    ("def target(self):\n return 0.0, 0.0", ["target of 'tank' is a method: write @property above its def"]),
    ("@property\ndef target(self):\n return self.kk, 0.0", ["target of 'tank' failed in", "(`return self.kk, 0.0`)"]),
    ("def draw_starts(self, rng, n, factor=1.0):\n return rng.random(2)", ["shape (n, 2), got an array of shape (2,)"]),
    ("def draw_starts(self, rng, n):\n return rng.unifrom(n)", ["draw_starts(rng, n) of 'tank' failed in", "unifrom"]),
]  # fmt: skip


@pytest.mark.parametrize(("definition", "said"), DEFINITIONS, ids=[definition for definition, _ in DEFINITIONS])
def test_a_definition_that_is_wrong(tank, definition, said):
    with pytest.raises(EquationError) as raised:
        get_system(f"{tank(more=definition)}:Tank")
    assert all(text in str(raised.value) for text in said)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("k: float = 2.0", "k: float", "Tank has no default for k: give one, or pass an instance"),
        ("@dataclass(frozen=True)\n", "", "Tank has a parameter k, but lacks @dataclass(frozen=True)"),
        ("import numpy", "import nunpy", "line 3 (`import nunpy as np`): ModuleNotFoundError: No module named 'nunpy'"),
        ("class Tank", "class Barrel", "tank0.py defines no Tank; it defines Barrel"),
    ],
)  # fmt: skip
def test_a_script_that_is_wrong(tank, old, new, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        get_system(f"{tank(head=HEAD.replace(old, new))}:Tank")


@pytest.mark.parametrize("name", ["f", "h"])
def test_missing_equations(tank, name):
    path = tank()
    path.write_text(path.read_text().replace(f"def {name}(", "def another("))
    with pytest.raises(EquationError, match=rf"^Tank defines no {name}\(self, x\)$"):
        get_system(f"{path}:Tank")


HERE = r"failed in tests/helpers/wrong_systems\.py, line \d+ \(`return x\[1\], -math\.sin\(x\[0\]\)`\): TypeError: "
USE_SIN = r"use kkl_gym\.elementary\.sin, which serves floats, arrays, tensors and symbols"
many = np.full((2, 7), 0.5)
none = np.zeros((1, 7))


@pytest.mark.parametrize(
    "call",
    [
        lambda: Late().drift(many.T),
        lambda: advance_batch(Late(), many, none, 0.0 * many, 0.01),
        lambda: batch_step(Late())(many, none, 0.0 * many, 0.01),
        lambda: KKLVectorEnv(Late(), 3),
    ],
)
def test_every_way_to_evaluate_arrays_says_where(call):
    with pytest.raises(EquationError, match=rf"f\(x\) of 'late' {HERE}.* x held arrays of shape \(\d,\): {USE_SIN}"):
        call()
    with pytest.raises(
        EquationError, match=r"^h\(x\) of 'late' failed in tests/.*, line \d+ .*kkl_gym\.elementary\.cos"
    ):
        Late().output(many.T)


def test_tracing_says_where():
    for step_of in (single_step, batch_step):
        assert re.match(
            rf"EquationError: f\(x\) of 'late' {HERE}.*; x held symbols: {USE_SIN}", step_of(Late()).obstacle
        )


class Long(Wide):
    name = "long"
    dt = 0.01

    def step(self, x, u):
        return self.f(x)


@pytest.mark.parametrize("system", [Long(), Wide()])
def test_what_a_loop_cannot_take_is_looked_at_again(system):
    message = r"^(f\(x\) of 'wide'|step\(x, u\) of 'long') \(.*\) must return 2 .* 3 of them"
    with pytest.raises(EquationError, match=message):
        advance(system, (0.5, 0.5), (0.0,), (0.0, 0.0), 0.01)
    with pytest.raises(EquationError, match=message):
        advance_batch(system, many, none, 0.0 * many, 0.01)


class Draining(Late):
    """A tank that runs empty, after which its level is no number any more."""

    name = "draining"

    def f(self, x):
        return -3.0 * self.root(x[0]), -x[1]

    def root(self, level):
        return level**0.5

    def h(self, x):
        return (x[0],)


class Stepping(Draining):
    """The same in discrete time."""

    name = "stepping"
    dt = 0.1

    def step(self, x, u):
        return (x[0] - 0.1) ** 0.5, x[1]


REAL = "must return real numbers; it returned complex ones on the way from x"


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (Draining(), rf"f\(x\) of 'draining' \(.*\) {REAL}"),
        (Stepping(), rf"step\(x, u\) of 'stepping' \(.*\) {REAL}"),
    ],
)
def test_steps_that_leave_the_real_numbers(system, message):
    env = KKLEnv(system, measurement_noise=0.1, dt=0.1)
    env.reset(seed=0, options={"x0": [0.01, 0.0]})
    with pytest.raises(EquationError, match=message):
        env.step(np.zeros(1))


def test_equations_that_write_to_the_state(tank):
    path = tank(more="def g(self, x):\n    a, b = x\n    a *= 0.0\n    return (a,), (1.0 + a,)", h="(x[0] + 0.0,)")
    with pytest.raises(EquationError, match=r"g\(x\) of 'tank' .* changed the state that it was given: write a = a"):
        KKLEnv(f"{path}:Tank")


def test_where_leaves_out_what_is_divided_by_zero():
    class Cardinal(Draining):
        name = "cardinal"

        def f(self, x):
            return x[1], -elementary.where(x[0] != 0.0, elementary.sin(x[0]) / x[0], 1.0) * x[0]

    single = advance(Cardinal(), (0.0, 1.0), [0.0], [0.0, 0.0], 0.01)
    batch = advance_batch(Cardinal(), np.array([[0.0], [1.0]]), np.zeros((1, 1)), np.zeros((2, 1)), 0.01)
    np.testing.assert_allclose(single, batch[:, 0], rtol=1e-14)
    assert single[0] == pytest.approx(math.sin(0.01), abs=1e-7)


@pytest.mark.parametrize("make", [KKLEnv, lambda system: KKLVectorEnv(system, 2)])
def test_a_target_that_does_not_exist_is_for_environments_to_miss(tank, make):
    path = tank(more="@property\ndef target(self):\n    raise ValueError('no equilibrium')")
    system = get_system(f"{path}:Tank")
    with pytest.raises(EquationError, match=r"\(`raise ValueError\('no equilibrium'\)`\): ValueError: no eq") as raised:
        make(system)
    assert str(raised.value).startswith(f"target of 'tank' failed in {path}, line ")


def test_bounds_within_which_an_output_is_lost():
    class Lost(Draining):
        name = "lost"

        def h(self, x):
            return (elementary.sqrt(x[0]), x[0] / x[1])

    with pytest.raises(EquationError, match=r"h\(x\) of 'lost' .* must return numbers everywhere within .*: tighten"):
        KKLEnv(Lost())


def test_constants_of_single_precision(tank):
    path = tank(f="x[1], np.float32(-2.0) * x[0]")
    with pytest.raises(EquationError, match="would make a whole motion that coarse: write constants as Python's"):
        KKLEnv(f"{path}:Tank")


def test_equations_without_source():
    names = {}
    exec("import math\ndef f(self, x):\n    return x[1], math.sin(x[0])", names)
    kind = type("Typed", (Draining,), {"name": "typed", "f": names["f"]})
    with pytest.raises(EquationError, match=r"^f\(x\) of 'typed' failed in <string>, line 3: TypeError: .* equations"):
        get_system(kind)
