"""Systems that a script or a notebook defines are pickled by value for other processes."""

import multiprocessing
import shutil
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from functools import partial

import cloudpickle
import gymnasium as gym
import linear_system
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from notebook_systems import springs

import kkl_gym
from kkl_gym import KKLEnv, System

# A test class combines one choice of each kind; the choices must be independent of one another.
BODIES = {
    "decorator": ["", "@dataclass(frozen=True)"],
    "base": ["System", "VanDerPol", "Parent", "Mixin, System"],
    "place": ["notebook", "function"],
    "parameters": ["", "k: float = 1.5", "k: float = 1.5\n    tau: float = 2.0"],
    "f": ["", "def f(self, x):\n        return x[1], -helper(x[0]) - getattr(self, 'k', 1.0) * x[1]"],
    "h": ["", "def h(self, x):\n        return x[0], WEIGHT * x[1]", "h = lambda self, x: (x[0] + shift,)"],
    "rate": ["", "def rate(self, x):\n        return 1.0 + abs(x[0])", "rate = System.rate"],
    "g": ["", "def g(self, x):\n        return (0.0,), (1.0 + 0.1 * x[0],)"],
    "task": ["", "def reward(self, x, u):\n        return -helper(x[0]) ** 2 - u[0] * u[0]",
             "@property\n    def target(self):\n        return 0.1, 0.0",
             "def terminated(self, x):\n        return x[0] > WEIGHT"],
    "more": ["", "scale = (0.5, 2.0)", "dt = 0.05", "dt: ClassVar[float] = 0.02", "process_noise = 0.0"],
}  # fmt: skip
SCRIPT = """
from dataclasses import dataclass
from typing import ClassVar
from kkl_gym import System, VanDerPol
from kkl_gym.elementary import sin

WEIGHT = 0.5

def helper(angle):
    return WEIGHT * sin(angle)

class Mixin:
    def f(self, x):
        return x[1], -x[0]

    def h(self, x):
        return (x[0],)

@dataclass(frozen=True)
class Parent(Mixin, System):
    mass: float = 1.0

    name = "parent"
    X = ((-1.0, 1.0), (-1.0, 1.0))
    bounds = ((-9.0, 9.0), (-9.0, 9.0))
    u_max = (1.0,)
    G = ((0.0,), (1.0,))
"""
OWN = "X = ((-1, 1), (-2, 2))\n    bounds = ((-9, 9), (-9, 9))\n    u_max = (2.0,)\n    G = ((0.0,), (1.0,))"


def defined(choices):
    """The class for some choices, defined as in the cell of a notebook or in a function."""
    base, own = choices["base"], {} if "System" not in choices["base"] else {"own": OWN}
    if base == "System":
        own["equations"] = "f, h = Mixin.f, Mixin.h"
    parts = [*own.values(), *(choices[part] for part in ("f", "h", "rate", "g", "task", "more"))]
    if choices["decorator"]:
        parts.insert(0, choices["parameters"])
    body = "\n    ".join(part for part in ('name = "made"', *parts) if part)
    text = f"{choices['decorator']}\nclass Made({base}):\n    {body}\n"
    if choices["place"] == "function":
        text = "def make(shift):\n" + "".join(f"    {line}\n" for line in text.splitlines()) + "    return Made\n"
        text += "\nMade = make(0.25)\n"
    names = {"__name__": "__main__", "shift": 0.25}
    exec(SCRIPT + text, names)
    return names["Made"]


def looked_at(system):
    """A trajectory of a system, and its declared attributes."""
    env = KKLEnv(system)
    env.reset(seed=3)
    motion = [env.step(np.array([action])) for action in (0.3, -1.0)]
    system = env.system
    return repr([motion, system.parameters, system.X, system.scale, system.state_names, system.dt, system.target])


def received(sent):
    return looked_at(cloudpickle.loads(sent))


@pytest.fixture(scope="module")
def elsewhere():
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield lambda sent: pool.submit(received, sent).result()


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.fixed_dictionaries({part: st.sampled_from(choices) for part, choices in BODIES.items()}), st.booleans())
def test_a_class_is_unchanged_in_a_new_process(elsewhere, choices, instance):
    made = defined(choices)
    system = made() if instance else made
    assert elsewhere(cloudpickle.dumps(system)) == looked_at(system)


def start(make):
    return make().reset(seed=0)[0].tolist()


def in_async(make, context):
    with closing(AsyncVectorEnv([make], context=context)) as envs:
        return envs.reset(seed=0)[0][0].tolist()


def in_subproc(make):
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    with closing(vec_env.SubprocVecEnv([make])) as envs:
        envs.seed(0)
        return envs.reset()[0].tolist()


def in_loky(make):
    joblib = pytest.importorskip("joblib")
    return joblib.Parallel(n_jobs=2, backend="loky")([joblib.delayed(start)(make)] * 2)[0]


SPAWN, FORKSERVER = (partial(in_async, context=name) for name in ("spawn", "forkserver"))


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("played", [SPAWN, FORKSERVER, in_subproc, in_loky])
def test_workers_play_systems_of_a_notebook(played, which):
    system = springs()[which]
    make = lambda: gym.make(kkl_gym.OWN_ID, system=system() if which else system)  # noqa: E731 - as notebooks do
    assert played(make) == start(make)


def test_a_class_without_declarations_is_checked_at_its_first_use():
    class Empty(System):
        pass

    with pytest.raises(TypeError, match="Empty must set the class variables name, X and bounds; it lacks name"):
        Empty()


@pytest.mark.parametrize(("where", "instance"), [("script", True), ("module", False)])
def test_worker_processes_find_the_class_by_its_name(where, instance, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(linear_system.__file__, tmp_path / "found_from_here.py")
    name = "found_from_here:Oscillator" if where == "module" else "found_from_here.py:Oscillator"
    make = partial(gym.make, f"kkl_gym:{kkl_gym.OWN_ID}", system=kkl_gym.get_system(name) if instance else name)
    assert SPAWN(make) == start(make)
