"""An angle on a circle: a pendulum that can turn over. The state holds the cosine and sine of its angle.

To train an observer for it from the command line, with the default settings::

    kkl-gym train examples/circle_pendulum.py:CirclePendulum

docs/guides/your_system.md explains such plants.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import tyro
from rich.console import Console

import kkl_gym
from training import preset, train


@dataclass(frozen=True)
class CirclePendulum(kkl_gym.System):
    """Pendulum-v1's pendulum: cosine and sine of the angle are measured, the rate is hidden. The angle is 0 upright."""

    gravity: float = 10.0  # m/s^2
    mass: float = 1.0  # kg
    length: float = 1.0  # m

    name: ClassVar[str] = "circle_pendulum"
    state_names: ClassVar = ("cosine", "sine", "rate in rad/s")
    X: ClassVar = ((-1.0, 1.0), (-1.0, 1.0), (-8.0, 8.0))
    bounds: ClassVar = ((-1.5, 1.5), (-1.5, 1.5), (-25.0, 25.0))
    u_max: ClassVar = (2.0,)  # N m
    process_noise: ClassVar = 0.0  # noise would push states off the circle
    target: ClassVar = (1.0, 0.0, 0.0)

    def draw_starts(self, rng, n, factor=1.0):
        """Draw any angle, and rates within a multiple of X."""
        angle = rng.uniform(-np.pi, np.pi, n)
        low, high = self.box(factor)
        return np.stack([np.cos(angle), np.sin(angle), rng.uniform(low[2], high[2], n)], axis=-1)

    def f(self, x):
        """Drift."""
        cosine, sine, rate = x
        return -sine * rate, cosine * rate, 1.5 * self.gravity / self.length * sine

    def g(self, x):
        """Input matrix."""
        return (0.0,), (0.0,), (3.0 / (self.mass * self.length**2),)

    def h(self, x):
        """Output."""
        return x[0], x[1]


def main(inverse_steps: int = 1500, trajectories: int = 500, out: Path = Path("runs/circle_pendulum")) -> np.ndarray:
    """Train, then swing up by the estimate; returns rms errors of x_hat after a fifth of the run, in half-widths of X.

    Args:
        inverse_steps: number of training batches.
        trajectories: number of simulated trajectories to train on.
        out: the run's folder.
    """
    system = CirclePendulum()
    sizes = {"inverse_steps": inverse_steps, "trajectories": trajectories, "duration": 10.0}
    config = preset(system, changes=sizes)
    path = out / "circle_pendulum.safetensors"
    train(system, config, out, resume=True, console=Console()).artifact.save(path)

    env = kkl_gym.KKLObservation(kkl_gym.KKLEnv(system), observer=str(path))
    x_hat, info = env.reset(seed=0)
    errors = []
    for _ in range(1000):
        top = 1.5 * system.gravity / system.length  # potential energy at the top, divided by the moment of inertia
        missing = top - x_hat[2] ** 2 / 2 - top * x_hat[0]
        # The policy brings the energy to that of the pendulum at rest at the top.
        x_hat, _, _, _, info = env.step(np.clip(missing * x_hat[2:], -1.0, 1.0))
        errors.append(x_hat - info["x"])
    print(f"after {len(errors) * env.unwrapped.dt:g} s: x = {info['x'].round(3)}, x_hat = {x_hat.round(3)}")
    late = np.square(errors[len(errors) // 5 :]).mean(0) ** 0.5 / system.scale
    print(f"rms error after the first fifth of this time, in half-widths of X: {late.round(3)}")
    return late


if __name__ == "__main__":
    tyro.cli(main)
