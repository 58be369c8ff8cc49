"""States at which the forward map's equation is asked to hold."""

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System

NEAR = 0.4  # share of the motions that start in X itself, the others in all of the enlarged box
MOTION = 20.0  # s
SAMPLES = 400  # points along a motion


def collocation(system: System, n: int, *, box_factor: float, rng: np.random.Generator) -> np.ndarray:
    """Draw states along motions, more of which start in X than in the rest of a larger box.

    Parameters
    ----------
    system : System
        What moves.
    n : int
        Number of states.
    box_factor : float
        The larger box is this multiple of X.
    rng : Generator
        Of everything random.

    Returns
    -------
    ndarray, shape (n, nx)
        States in random order.

    Raises
    ------
    ValueError
        If motions leave the system's bounds too soon.
    """
    motions = max(50, 2 * n // SAMPLES)
    near = round(NEAR * motions)
    x0 = np.concatenate(
        [
            rng.uniform(*system.box(), (near, system.nx)),
            rng.uniform(*system.box(box_factor), (motions - near, system.nx)),
        ]
    )
    x = simulate(system, x0, SAMPLES, MOTION / SAMPLES).reshape(-1, system.nx)
    x = x[np.isfinite(x).all(1)]  # what was inside before a motion left is good enough
    if len(x) < n:
        raise ValueError(f"motions from {box_factor:g} X leave bounds = {system.bounds} too soon")
    return np.asarray(x[rng.permutation(len(x))[:n]])
