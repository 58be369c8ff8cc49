"""Random bounded inputs that excite a system."""

from collections.abc import Sequence

import numpy as np

from kkl_gym.system import System

KINDS = ("zero", "steps", "zero", "sine")
DRIVEN = ("steps", "sine", "pulses")


def random_inputs(
    system: System, n: int, steps: int, *, dt: float, rng: np.random.Generator, kinds: tuple[str, ...] = KINDS
) -> np.ndarray:
    """Draw random inputs, held over each sampling interval. Shapes: returns (steps, n, nu)."""
    return random_signals(system.u_max, n, steps, dt=dt, pace=system.pace, rng=rng, kinds=kinds)


def random_signals(
    bounds: Sequence[float],
    n: int,
    steps: int,
    *,
    dt: float,
    pace: float,
    rng: np.random.Generator,
    kinds: tuple[str, ...],
) -> np.ndarray:
    """Draw random bounded signals (steps, n, k), held over each sampling interval."""
    out = np.zeros((steps, n, len(bounds)))
    t = np.arange(steps) * dt
    for row in range(n):
        kind = kinds[row % len(kinds)]
        for j, bound in enumerate(bounds):
            if kind in ("steps", "pulses"):
                hold = pace * np.exp(rng.uniform(np.log(0.05), np.log(5.0)))
                changes = rng.random(steps) < min(1.0, dt / hold)
                levels = rng.uniform(-bound, bound, steps + 1)
                out[:, row, j] = levels[np.cumsum(changes)]
                if kind == "pulses":
                    out[rng.integers(steps + 1) :, row, j] = 0.0
            elif kind == "sine":
                amplitude, phase = rng.uniform(0, bound), rng.uniform(0, 2 * np.pi)
                frequency = np.exp(rng.uniform(np.log(0.2), np.log(20.0))) / pace
                out[:, row, j] = amplitude * np.sin(frequency * t + phase)
    return out
