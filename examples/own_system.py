"""Bring your own system: define it, train an observer for it, run this observer inside an environment, evaluate it.

Training and evaluation from the command line, with default settings::

    kkl-gym train examples/own_system.py:Pendulum
    kkl-gym evaluate runs/pendulum/pendulum.safetensors --system examples/own_system.py:Pendulum

docs/guides/your_system.md has the other commands, and shows how to register an environment id.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import tyro
from rich.console import Console

import kkl_gym
from kkl_gym.elementary import sin
from training import errors, preset, train, unseen_trajectories


@dataclass(frozen=True)
class Pendulum(kkl_gym.System):
    """A lightly damped pendulum with a torque; the angle is measured, its rate is not."""

    gravity: float = 5.0  # gravitational acceleration / length, in 1/s^2
    damping: float = 0.1  # 1/s

    name: ClassVar[str] = "pendulum"
    state_names: ClassVar = ("angle in rad", "rate in rad/s")
    X: ClassVar = ((-1.5, 1.5), (-2.0, 2.0))
    bounds: ClassVar = ((-10.0, 10.0), (-20.0, 20.0))
    u_max: ClassVar = (1.0,)
    G: ClassVar = ((0.0,), (1.0,))

    def f(self, x):
        """Drift."""
        angle, rate = x
        return rate, -self.gravity * sin(angle) - self.damping * rate

    def h(self, x):
        """Output."""
        return (x[0],)


def main(inverse_steps: int = 1500, trajectories: int = 500, out: Path = Path("runs/pendulum")) -> float:
    """Train, wrap and evaluate; returns the median SMAPE without noise, in percent.

    Args:
        inverse_steps: batches of training.
        trajectories: simulated trajectories to train on.
        out: the run's folder.
    """
    system = Pendulum()
    sizes = {
        "inverse_steps": inverse_steps,
        "trajectories": trajectories,
        "duration": 20.0,
        "measurement_noise_max": 0.5,
    }
    config = preset(system, changes=sizes)
    artifact = train(system, config, out, resume=True, console=Console()).artifact
    path = out / "pendulum.safetensors"
    artifact.save(path)

    env = kkl_gym.KKLObservation(kkl_gym.KKLEnv(system, measurement_noise=0.1), observer=str(path))
    x_hat, info = env.reset(seed=0)
    for _ in range(1000):
        x_hat, _, _, _, info = env.step(np.zeros(1, np.float32))
    print(f"after 10 s: x = {info['x'].round(3)}, x_hat = {x_hat.round(3)}")

    runs = unseen_trajectories(system, env.unwrapped.dt, n=20, duration=20.0, seed=0)
    found = errors(artifact, system, runs, measurement_noise=0.0, seed=0)
    print(f"SMAPE without noise, median of 20 runs: {np.median(found.full):.2f} %")
    return float(np.median(found.full))


if __name__ == "__main__":
    tyro.cli(main)
