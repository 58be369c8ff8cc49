"""Random bounded inputs that excite a system."""

from collections.abc import Sequence

import numpy as np

from kkl_gym.system import System

KINDS = ("zero", "steps", "zero", "sine")
DRIVEN = ("steps", "sine", "pulses")


def random_inputs(
    system: System, n: int, steps: int, *, dt: float, rng: np.random.Generator, kinds: tuple[str, ...] = KINDS
) -> np.ndarray:
    """Draw random inputs, held over each sampling interval.

    Parameters
    ----------
    system : System
        What they are to drive, within its input bounds and at its pace.
    n : int
        Number of trajectories.
    steps : int
        Number of sampling intervals.
    dt : float
        Their length in seconds.
    rng : Generator
        Of everything random.
    kinds : tuple of str
        As of :func:`random_signals`; by default "zero" twice as often as each of the others.

    Returns
    -------
    ndarray, shape (steps, n, nu)
        The inputs, in their own units.
    """
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
    """Draw random bounded signals, held over each sampling interval.

    Parameters
    ----------
    bounds : sequence of float, length k
        Largest magnitude of each component.
    n : int
        Number of signals.
    steps : int
        Number of sampling intervals.
    dt : float
        Their length in seconds.
    pace : float
        Seconds that are to the system what one second is to those that ship, see :attr:`kkl_gym.System.pace`.
    rng : Generator
        Of everything random.
    kinds : tuple of str
        The signals are of these in turn:

        - "zero": nothing;
        - "steps": values uniform within the bounds, held for times that are log-uniform in 0.05 to 5 s at that pace;
        - "pulses": the same up to a time uniform within the record, and nothing from there on;
        - "sine": amplitudes uniform up to the bounds, angular frequencies log-uniform in 0.2 to 20 rad/s
          at that pace.

    Returns
    -------
    ndarray, shape (steps, n, k)
        The signals, in units of the bounds.
    """
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
