"""Pairs of state and filter state, along simulated trajectories."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import LinearFilter
from training.signals import random_inputs

CHUNK = 500  # trajectories simulated at once


@dataclass(frozen=True)
class Trajectories:
    """Noise-free trajectories of a system with the filter running beside them from its own start.

    ages : samples since reset at which they were recorded, sorted, (m,).
    x : (m, n, nx).
    z : (m, n, size of the filter's state).
    """

    ages: np.ndarray
    x: np.ndarray
    z: np.ndarray


def output(system: System, x: np.ndarray) -> np.ndarray:
    """h on states of shape (..., nx), as (..., ny)."""
    return np.stack([np.broadcast_to(yi, x.shape[:-1]) for yi in system.h(np.moveaxis(x, -1, 0))], axis=-1)


def recording_ages(first: int, steps: int, n: int) -> np.ndarray:
    """At most n ages from ``first`` to ``steps``, even in time; from 0, half of them even in the logarithm instead.

    Those catch the transient.
    """
    if first > 0:
        return np.unique(np.linspace(first, steps, n).round()).astype(int)
    early = np.geomspace(1, steps, n // 2).round()
    late = np.linspace(0, steps, n - n // 2).round()
    return np.unique(np.concatenate([early, late])).astype(int)


def record(
    system: System,
    linear: LinearFilter,
    n: int,
    steps: int,
    ages: np.ndarray,
    rng: np.random.Generator,
    report: Callable[[int], None] = lambda done: None,
) -> Trajectories:
    """Simulate n trajectories from starts uniform in the training box, under random inputs if the filter takes any.

    Trajectories that leave the declared bounds are replaced by new ones; ``report`` is told how many there are so far.
    """
    xs: list[np.ndarray] = []
    zs: list[np.ndarray] = []
    for x, u in trajectories(system, n, steps, linear.dt, rng, driven=linear.nu > 0):
        xs.append(x[ages])
        zs.append(run_filter(linear, output(system, x), u, ages))
        report(sum(x.shape[1] for x in xs))
    return Trajectories(ages, np.concatenate(xs, 1), np.concatenate(zs, 1))


def trajectories(
    system: System, n: int, steps: int, dt: float, rng: np.random.Generator, driven: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """n trajectories from starts uniform in the training box, in chunks: states and inputs, (steps (+ 1), CHUNK, ...).

    Those that leave the declared bounds are replaced by new ones.
    """
    kept = tried = 0
    while kept < n:
        count = min(CHUNK, n - kept)
        x0 = rng.uniform(*system.box(), (count, system.nx))
        u = random_inputs(system, count, steps, dt, rng) if driven else np.zeros((steps, count, 0))
        x = simulate(system, x0, steps, dt, u=u if driven else None)
        inside = np.isfinite(x[-1]).all(-1)
        kept += int(inside.sum())
        tried += count
        if tried > 20 * n:
            raise ValueError(
                f"of {tried} trajectories of {steps * dt:g} s only {kept} stayed within bounds = "
                f"{system.bounds}; widen the bounds, shrink X or shorten the trajectories"
            )
        yield x[:, inside], u[:, inside]


def run_filter(linear: LinearFilter, y: np.ndarray, u: np.ndarray, ages: np.ndarray) -> np.ndarray:
    """The filter's state at ``ages`` along outputs (steps + 1, n, ny) and inputs (steps, n, nu): (m, n, size)."""
    z = linear.start(y[0])
    out = np.empty((len(ages), *z.shape))
    slot = {int(age): i for i, age in enumerate(ages)}
    for k in range(len(y)):
        if k > 0:
            z = linear.advance(z, y[k - 1], u[k - 1], y[k])
        if k in slot:
            out[slot[k]] = z
    return out
