"""An unstable plant, the cart-pole. Its observer is trained under one policy; another policy acts on the estimate.

Training and evaluation from the command line::

    kkl-gym train examples/cart_pole.py:CartPole --policy controller
    kkl-gym evaluate runs/cart_pole/cart_pole.safetensors --system examples/cart_pole.py:CartPole

docs/guides/your_system.md explains unstable plants.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import tyro
from rich.console import Console

import kkl_gym
from kkl_gym.elementary import cos, sin
from training import preset, train


@dataclass(frozen=True)
class CartPole(kkl_gym.System):
    """CartPole-v1's cart-pole with a continuous force; position and angle are measured, their rates are not."""

    gravity: float = 9.8  # m/s^2
    cart: float = 1.0  # kg
    pole: float = 0.1  # kg
    length: float = 0.5  # m, half the length of the pole

    name: ClassVar[str] = "cart_pole"
    state_names: ClassVar = ("position in m", "velocity in m/s", "angle in rad", "rate in rad/s")
    X: ClassVar = ((-1.0, 1.0), (-1.0, 1.0), (-0.2, 0.2), (-1.0, 1.0))
    bounds: ClassVar = ((-4.8, 4.8), (-10.0, 10.0), (-0.8, 0.8), (-10.0, 10.0))
    u_max: ClassVar = (10.0,)  # N
    measurement_noise: ClassVar = 0.02  # m and rad

    def _terms(self, x):
        """Return the total mass, the pole's mass times half-length, and the denominator of the angular acceleration."""
        mass, moment = self.cart + self.pole, self.pole * self.length
        return mass, moment, self.length * (4.0 / 3.0 - self.pole * cos(x[2]) ** 2 / mass)

    def f(self, x):
        """Drift."""
        _, velocity, angle, rate = x
        mass, moment, inertia = self._terms(x)
        push = moment * rate**2 * sin(angle) / mass
        turn = (self.gravity * sin(angle) - cos(angle) * push) / inertia
        return velocity, push - moment * turn * cos(angle) / mass, rate, turn

    def g(self, x):
        """Input matrix."""
        mass, moment, inertia = self._terms(x)
        turn = -cos(x[2]) / (mass * inertia)
        return (0.0,), (1.0 / mass - moment * turn * cos(x[2]) / mass,), (0.0,), (turn,)

    def h(self, x):
        """Output."""
        return x[0], x[2]


def balance(x: np.ndarray) -> np.ndarray:
    """Map states (n, 4) to actions (n, 1) in [-1, 1], by a policy other than that of the training."""
    return np.clip(x @ [[0.3], [0.5], [4.0], [1.0]], -1.0, 1.0)


def main(inverse_steps: int = 1500, trajectories: int = 500, out: Path = Path("runs/cart_pole")) -> np.ndarray:
    """Train, then act on the estimate; returns its rms errors after the run's first fifth, in half-widths of X.

    Args:
        inverse_steps: number of training batches.
        trajectories: number of simulated trajectories to train on.
        out: the run's folder.
    """
    system = CartPole()
    sizes = {"inverse_steps": inverse_steps, "trajectories": trajectories, "duration": 10.0}
    config = preset(system, changes={**sizes, "policy": "controller"})
    path = out / "cart_pole.safetensors"
    train(system, config, out, resume=True, console=Console()).artifact.save(path)

    env = kkl_gym.KKLObservation(kkl_gym.KKLEnv(system), observer=str(path))
    x_hat, info = env.reset(seed=0)
    errors = []
    for _ in range(1000):
        x_hat, _, fallen, _, info = env.step(balance(x_hat[None])[0])  # the policy sees only the estimate
        errors.append(x_hat - info["x"])
        if fallen:
            break
    print(f"after {len(errors) * env.unwrapped.dt:g} s: x = {info['x'].round(3)}, x_hat = {x_hat.round(3)}")
    late = np.square(errors[len(errors) // 5 :]).mean(0) ** 0.5 / system.scale
    print(f"rms error after the first fifth of this time, in half-widths of X: {late.round(3)}")
    return late


if __name__ == "__main__":
    tyro.cli(main)
