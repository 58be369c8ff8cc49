"""Random bounded inputs that excite a system."""

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
        What they are to drive.
    n : int
        Number of trajectories.
    steps : int
        Number of sampling intervals.
    dt : float
        Their length in seconds.
    rng : Generator
        Of everything random.
    kinds : tuple of str
        The trajectories are of these in turn:

        - "zero": no input (twice as often as each of the others by default);
        - "steps": values uniform within the input bounds, held for times that are log-uniform in 0.05 to 5 s at the
          pace of the shipped systems, see :attr:`kkl_gym.System.pace`;
        - "pulses": the same up to a time uniform within the record, and no input from there on;
        - "sine": amplitudes uniform up to the bounds, angular frequencies log-uniform in 0.2 to 20 rad/s
          at that pace.

    Returns
    -------
    ndarray, shape (steps, n, nu)
        The inputs, in their own units.
    """
    u = np.zeros((steps, n, system.nu))
    t = np.arange(steps) * dt
    for row in range(n):
        kind = kinds[row % len(kinds)]
        for j, u_max in enumerate(system.u_max):
            if kind in ("steps", "pulses"):
                hold = system.pace * np.exp(rng.uniform(np.log(0.05), np.log(5.0)))
                changes = rng.random(steps) < min(1.0, dt / hold)
                levels = rng.uniform(-u_max, u_max, steps + 1)
                u[:, row, j] = levels[np.cumsum(changes)]
                if kind == "pulses":
                    u[rng.integers(steps + 1) :, row, j] = 0.0
            elif kind == "sine":
                amplitude, phase = rng.uniform(0, u_max), rng.uniform(0, 2 * np.pi)
                frequency = np.exp(rng.uniform(np.log(0.2), np.log(20.0))) / system.pace
                u[:, row, j] = amplitude * np.sin(frequency * t + phase)
    return u
