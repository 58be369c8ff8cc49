"""Where a system goes in the long run, with the filter beside it: the samples that certificates are made of."""

import math
from dataclasses import dataclass, fields

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import Artifact
from training.evaluation.levels import Level
from training.seeds import Stream, generator
from training.trajectories.motions import Controller, draw_process_noise, filter_states, under_policy

SETTLED = 1e-4  # part of the filter's start that is left where recording begins
RECORDED = 30.0  # seconds of each trajectory, at the pace of the shipped systems
EVERY = 10  # samples between recorded ones
TRUNCATED = 3.0  # standard deviations at which Gaussian noise is cut, for theorems about bounded noise


@dataclass(frozen=True)
class SettledTrajectories:
    """Trajectories from where the filter has forgotten its start, one behind the other.

    Shapes: ``x`` (n, nx), ``z`` (n, size), ``noisy_x`` (n, nx), ``noisy_z`` (n, size), ``noise`` (n, size).
    """

    x: np.ndarray
    z: np.ndarray
    noisy_x: np.ndarray
    noisy_z: np.ndarray
    noise: np.ndarray
    trajectories: int

    def halves(self) -> tuple["SettledTrajectories", "SettledTrajectories"]:
        """The first half of the trajectories, and the rest."""
        first = self.trajectories // 2
        cut = first * (len(self.x) // self.trajectories)

        def part(rows: slice, trajectories: int) -> "SettledTrajectories":
            signals = {entry.name: getattr(self, entry.name)[rows] for entry in fields(self)[:-1]}
            return SettledTrajectories(**signals, trajectories=trajectories)

        return part(slice(cut), first), part(slice(cut, None), self.trajectories - first)


def record_settled(
    artifact: Artifact,
    system: System,
    *,
    measurement_noise: Level,
    process_noise: float,
    trajectories: int,
    seed: int,
    policy: Controller | None = None,
) -> SettledTrajectories:
    """Simulate trajectories from starts uniform in X, and record them once the filter has forgotten its start.

    Shapes: ``measurement_noise`` of length ny.
    """
    rng = generator(Stream.CERTIFICATE, seed)
    linear = artifact.filter
    dt = linear.dt
    settled = -math.log(SETTLED) / linear.slowest
    first = math.ceil(settled / dt)
    steps = first + round(RECORDED * system.pace / dt)
    ages = np.arange(first, steps + 1, EVERY)
    x0 = system.draw_starts(rng, trajectories)

    def moved(w: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        if policy is None:
            return simulate(system, x0, steps, dt, w=w), np.zeros((steps, trajectories, linear.nu))
        exploring, own = generator(Stream.CERTIFICATE, seed, 3), np.zeros(trajectories, dtype=bool)
        return under_policy(system, policy, x0, steps=steps, dt=dt, rng=exploring, own=own, w=w)

    x, u = noisy_x, noisy_u = moved()
    if process_noise:
        noisy_x, noisy_u = moved(draw_process_noise(system, process_noise, n=trajectories, steps=steps, rng=rng))
    inside = np.isfinite(x[-1]).all(-1) & np.isfinite(noisy_x[-1]).all(-1)
    if 2 * inside.sum() < trajectories:
        raise ValueError(
            f"only {inside.sum()} of {trajectories} trajectories of {steps * dt:g} s stayed within bounds = "
            f"{system.bounds}; widen the bounds, shrink X or lower process_noise = {process_noise:g}"
        )
    x, noisy_x, u, noisy_u = x[:, inside], noisy_x[:, inside], u[:, inside], noisy_u[:, inside]
    white = rng.standard_normal((*x.shape[:2], system.ny))
    v = np.asarray(measurement_noise) * np.clip(white, -TRUNCATED, TRUNCATED)

    def one_by_one(values: np.ndarray) -> np.ndarray:
        return np.moveaxis(values, 0, 1).reshape(-1, values.shape[-1])

    def filtered(y: np.ndarray, u: np.ndarray) -> np.ndarray:
        return one_by_one(filter_states(linear, y, u, ages))

    return SettledTrajectories(
        x=one_by_one(x[ages]),
        z=filtered(system.output(x), u),
        noisy_x=one_by_one(noisy_x[ages]),
        noisy_z=filtered(system.output(noisy_x) + v, noisy_u),
        noise=filtered(v, np.zeros_like(u)),
        trajectories=x.shape[1],
    )
