import os

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame must not open a window
os.environ.setdefault("MPLBACKEND", "agg")  # Matplotlib must not open a window, in any order of tests
os.environ.setdefault("OMP_NUM_THREADS", "1")  # set before NumPy and torch load; more threads than cores are slow

import pytest
from random_artifacts import random_artifact


@pytest.fixture(scope="session")
def make_artifact():
    return random_artifact


@pytest.fixture(scope="session")
def saved(tmp_path_factory):
    """save(system=..., ...) returns the path of a file that holds random_artifact(system=..., ...)."""
    folder, paths = tmp_path_factory.mktemp("maps"), {}

    def save(**options):
        key = tuple(sorted(options.items()))
        if key not in paths:
            path = folder / f"map-{len(paths)}.safetensors"
            random_artifact(**options).save(path)
            paths[key] = str(path)
        return paths[key]

    return save


AUTONOMOUS = """
from dataclasses import dataclass

from kkl_gym import System
from kkl_gym.elementary import sin


@dataclass(frozen=True)
class Pendulum(System):
    damping: float = 0.1

    name = "pendulum"
    X = ((-3.0, 3.0), (-2.0, 2.0))
    bounds = ((-50.0, 50.0), (-20.0, 20.0))

    def f(self, x):
        return x[1], -sin(x[0]) - self.damping * x[1]

    def h(self, x):
        return (x[0],)


class NoSystem:
    pass
"""


@pytest.fixture(scope="session")
def script(tmp_path_factory):
    """Path of a script that defines an autonomous system, Pendulum."""
    path = tmp_path_factory.mktemp("user") / "pendulum_script.py"
    path.write_text(AUTONOMOUS)
    return path
