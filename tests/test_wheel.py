"""The wheel, installed in an environment with its dependencies only."""

import os
import re
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest

pytestmark = pytest.mark.wheel

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CLEAN = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
USE = """
import sys
from importlib.util import find_spec

import gymnasium as gym

import kkl_gym
import observers

found = [name for name in ("torch", "scipy", "sympy", "numba", "matplotlib", "stable_baselines3") if find_spec(name)]
assert not found, f"{found} came along"
assert kkl_gym.__file__.startswith(sys.prefix), kkl_gym.__file__

env = kkl_gym.KKLObservation(gym.make("KKLLorenz-v0"))
x_hat, info = env.reset(seed=0)
for _ in range(10):
    x_hat, reward, terminated, truncated, info = env.step(env.action_space.sample())
assert x_hat in env.observation_space
assert info["sample"] == 10

envs = kkl_gym.KKLVectorObservation(gym.make_vec("KKLLorenz-v0", num_envs=2))
envs.reset(seed=0)
assert not envs.unwrapped.compiled
assert envs.step(envs.action_space.sample())[0].shape == (2, 3)
assert observers.load("van_der_pol", measurement_noise=0.5).reset([1.0]).shape == (2,)
print(gym.__version__)
"""


def run(*command):
    return subprocess.run(
        [str(part) for part in command], env=CLEAN, cwd=ROOT.anchor, capture_output=True, text=True, check=False
    )


def pip(*arguments):
    return run(sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments)


def made(folder):
    """Install the wheel in a new environment; return the folder of the environment's commands."""
    reached = pip("download", "--retries", "1", "--no-deps", "--dest", folder, *PROJECT["build-system"]["requires"])
    if reached.returncode:
        pytest.skip(f"no package index: {reached.stderr.strip().splitlines()[-1]}")
    built = pip("wheel", "--no-deps", "--wheel-dir", folder, ROOT)
    assert not built.returncode, built.stderr
    (wheel,) = folder.glob("kkl_gym-*.whl")
    venv.create(folder / "env")
    commands = folder / "env" / ("Scripts" if sys.platform == "win32" else "bin")
    installed = pip("--python", commands / "python", "install", wheel)
    assert not installed.returncode, installed.stderr
    return commands


def test_the_wheel_without_extras(tmp_path):
    """One test, so that only one of several test processes builds the wheel."""
    commands = made(tmp_path)
    used = run(commands / "python", "-I", "-W", "error", "-c", USE)
    assert not used.returncode, used.stderr

    asked = run(commands / "kkl-gym", "maps")
    assert asked.returncode
    assert "kkl-gym[train]" in asked.stderr

    (oldest,) = (
        found[1] for line in PROJECT["project"]["dependencies"] if (found := re.match(r"gymnasium>=([\d.]+)", line))
    )
    changed = pip("--python", commands / "python", "install", f"gymnasium=={oldest}.0")
    assert not changed.returncode, changed.stderr
    used = run(commands / "python", "-I", "-c", USE)
    assert not used.returncode, used.stderr
    assert used.stdout.strip() == f"{oldest}.0"
