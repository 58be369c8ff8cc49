"""Mistakes in a user's equations: each message names the system, the equation, file and line, and the fix."""

import itertools
import math
import pickle
import re
import textwrap
from functools import partial

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
    """Number of the last line of a script that contains `text`."""
    return max(i for i, line in enumerate(path.read_text().splitlines(), 1) if text in line)


def test_scripts_without_mistake(tank):
    system = get_system(f"{tank()}:Tank")
    assert system.nu == system.ny == 1
    path = tank(f="np.array([x[1], x[0]])", h="[np.where(x[0] > 0, 1.0, 0.0), 1]", more="target = np.zeros(2)")
    system = get_system(f"{path}:Tank")
    assert system.ny == 2
    assert system.target.shape == (2,)


@pytest.mark.parametrize(("f", "texts"), [
    ("(x[1] if x[0] > 0 else 0.0), x[0]", ["ValueError", "x held arrays of shape", "use kkl_gym.elementary.where"]),
    ("x[1], -math.sin(x[0])", ["TypeError", "x held arrays of shape", "use kkl_gym.elementary.sin"]),
    ("x[1], math.sqrt(-x[0])", ["ValueError", "x = (", "use kkl_gym.elementary.sqrt"]),
    ("x[1], self.kk * x[0]", ["AttributeError: 'Tank' object has no attribute 'kk'; x = ("]),
    ("x[2], x[0]", ["IndexError", "x has 2 components"]),
])  # fmt: skip
def test_an_equation_that_raises(tank, f, texts):
    path = tank(f=f)
    with pytest.raises(EquationError) as raised:
        get_system(f"{path}:Tank")
    message = str(raised.value)
    assert message.startswith(f"f(x) of 'tank' failed in {path}, line {line_of(path, f)} (`return {f}`): ")
    assert all(text in message for text in texts)
    assert str(pickle.loads(pickle.dumps(raised.value))) == message  # errors from worker processes arrive pickled


@pytest.mark.parametrize(("changes", "match"), [
    ({"f": "x[1]"}, r"^f\(x\) of 'tank' \(.*, line \d+\) must return 2 components, .*; it returned -"),
    ({"f": "x[1], x[0], 0.0"}, "must return 2 components, .* 3 of them"),
    ({"f": "x[0], (-x[0]) ** 0.5"}, "which is complex: use kkl_gym.elementary.sqrt for square roots"),
    ({"f": "x[1], 1e400 * x[0]"}, "must return finite numbers at each start"),
    ({"f": "x[1], np.sum(x)"}, "sum, max and norm mix the states of a batch"),
    ({"f": "x[1], np.where(x[1] < 0, x[0], np.max(x[0]))"}, r"(\[\S+, \S+\]) in a batch and (?!\1)"),
    ({"h": "x[0]"}, r"^h\(x\) of 'tank' .* must return its components in a sequence"),
    ({"f": "x[1], np.float32(-2.0) * x[0]"}, "which makes the whole motion imprecise: write constants as"),
    ({"more": "def f(self, x):\n return x[1], -friction(x[1])"}, r"\(`return math.tanh\(v\)`\).*elementary.tanh"),
    ({"more": "def f(x):\n return x"}, r"must be defined as f\(self, x\)"),
    ({"more": "def g(self, x):\n return (0.0,),"}, "must return 2 rows, one for each state, of 1 components"),
    ({"more": "def rate(self, x):\n return -1.0"}, "not below zero"),
    ({"more": "dt = 0.1\ndef step(self, x, u):\n return x[0], x[1], u[0]"}, r"^step\(x, u\) of 'tank' .* 3 of them"),
    ({"more": "def target(self):\n return 0.0, 0.0"}, "write @property above its def"),
    ({"more": "@property\ndef target(self):\n return self.kk, 0.0"}, r"^target of 'tank' .*\(`return self.kk, 0.0`\)"),
    ({"more": "def draw_starts(self, rng, n, factor=1.0):\n return rng.random(2)"}, r"shape \(n, 2\), got .* \(2,\)"),
], ids=str)  # fmt: skip
def test_a_definition_that_is_wrong(tank, changes, match):
    with pytest.raises(EquationError, match=f"(?s){match}"):
        KKLEnv(f"{tank(**changes)}:Tank")


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
    path = tank(head=HEAD.replace(old, new))
    for _ in range(2):  # a failed script does not stay half loaded
        with pytest.raises(ValueError, match=re.escape(message)):
            get_system(f"{path}:Tank")


@pytest.mark.parametrize("name", ["f", "h"])
def test_missing_equations(tank, name):
    path = tank()
    path.write_text(path.read_text().replace(f"def {name}(", "def another("))
    with pytest.raises(EquationError, match=rf"^Tank defines no {name}\(self, x\)$"):
        get_system(f"{path}:Tank")


LATE = r"f\(x\) of 'late' failed in tests/helpers/wrong_systems\.py, line \d+ \(.*\): TypeError: .*elementary\.sin"
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
def test_all_evaluations_of_arrays_name_the_place(call):
    with pytest.raises(EquationError, match=LATE):
        call()
    for step_of in (single_step, batch_step):
        assert re.match(f"EquationError: {LATE}", step_of(Late()).obstacle)


class Draining(Late):
    """A tank that runs empty; then the square root of its level is no longer real."""

    name = "draining"

    def f(self, x):
        return -3.0 * self.root(x[0]), -x[1]

    def root(self, level):
        return level**0.5

    def h(self, x):
        return (x[0],)


@pytest.mark.parametrize("make", [KKLEnv, partial(KKLVectorEnv, num_envs=2)])
def test_steps_that_leave_the_real_numbers(make):
    env = make(Draining(), dt=0.1)
    env.reset(seed=0, options={"x0": [0.01, 0.0]})
    with pytest.raises(EquationError, match=r"f\(x\) of 'draining' .* must return real numbers"):
        env.step(np.zeros(env.action_space.shape))


def test_a_component_too_many_is_named_where_a_loop_meets_it():
    for step in (lambda: advance(Wide(), (0.5, 0.5), (0.0,), (0.0, 0.0), 0.01),
                 lambda: advance_batch(Wide(), many, none, 0.0 * many, 0.01)):  # fmt: skip
        with pytest.raises(EquationError, match=r"^f\(x\) of 'wide' \(.*\) must return 2 .* 3 of them"):
            step()


def test_equations_that_write_to_the_state(tank):
    path = tank(more="def g(self, x):\n    a, b = x\n    a *= 0.0\n    return (a,), (1.0 + a,)", h="(x[0] + 0.0,)")
    with pytest.raises(EquationError, match=r"g\(x\) of 'tank' .* changed its argument, the state: write a = a"):
        KKLEnv(f"{path}:Tank")


def test_where_avoids_a_division_by_zero():
    class Cardinal(Draining):
        name = "cardinal"

        def f(self, x):
            return x[1], -elementary.where(x[0] != 0.0, elementary.sin(x[0]) / x[0], 1.0) * x[0]

    single = advance(Cardinal(), (0.0, 1.0), [0.0], [0.0, 0.0], 0.01)
    batch = advance_batch(Cardinal(), np.array([[0.0], [1.0]]), np.zeros((1, 1)), np.zeros((2, 1)), 0.01)
    np.testing.assert_allclose(single, batch[:, 0], rtol=1e-14)
    assert single[0] == pytest.approx(math.sin(0.01), abs=1e-7)


def test_a_target_that_does_not_exist_is_for_environments_to_miss(tank):
    path = tank(more="@property\ndef target(self):\n    raise ValueError('no equilibrium')")
    system = get_system(f"{path}:Tank")
    for make in (KKLEnv, partial(KKLVectorEnv, num_envs=2)):
        with pytest.raises(EquationError, match=r"^target of 'tank' failed in .*: ValueError: no equilibrium"):
            make(system)


def test_bounds_within_which_an_output_is_lost():
    class Lost(Draining):
        name = "lost"

        def h(self, x):
            return (elementary.sqrt(x[0]), x[0] / x[1])

    with pytest.raises(EquationError, match=r"h\(x\) of 'lost' .* must return numbers everywhere within .*: tighten"):
        KKLEnv(Lost())


def test_equations_without_source():
    names = {}
    exec("import math\ndef f(self, x):\n    return x[1], math.sin(x[0])", names)
    kind = type("Typed", (Draining,), {"name": "typed", "f": names["f"]})
    with pytest.raises(EquationError, match=r"^f\(x\) of 'typed' failed in <string>, line 3: TypeError: .* equations"):
        get_system(kind)
