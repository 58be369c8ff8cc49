"""Pairs under a controller that acts on an observer's estimate."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kkl_gym.simulate import advance_batch, followed_rows
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.trajectories.controllers import Controller
from training.trajectories.noise import ALIKE, draw_process_noise, noisy_output
from training.trajectories.policy import EXPLORATION
from training.trajectories.record import Pairs

HOLDS = (1, 5, 10, 20)  # samples for which actions are held
GROUPS = 50  # of closed-loop trajectories with a noise level and a time for which actions are held in common


@dataclass(frozen=True)
class ClosedLoop(Pairs):
    """Pairs under a controller that acts on an observer's estimate; z holds the noise that the observer saw."""

    measurement_noise: np.ndarray


def record_closed_loop(
    system: System,
    artifact: Artifact,
    controller: Controller,
    *,
    n: int,
    steps: int,
    ages: np.ndarray,
    rng: np.random.Generator,
    noise_free_share: float = 0.2,
    high_noise_emphasis: float = 2.0,
    process_noise_share: float = 0.0,
    report: Callable[[int], None] = lambda done: None,
) -> ClosedLoop:
    """Simulate trajectories from starts in X, in which the controller acts on x_hat, with exploration.

    The controller never acts on the true state: such inputs would tell the observer, which filters them, what it is to
    find out by itself. For the same reason noise is not added afterwards, but is what the observer and through it the
    controller saw. Groups of trajectories differ in noise level, in how long an action is held, and in the level of
    process noise if the observer is told it. Pairs of a group differ in how much is added to an action.
    """
    dt = artifact.filter.dt
    low, high = (np.array(bound)[:, None] for bound in zip(*system.bounds, strict=True))
    u_max = np.array(system.u_max)
    largest_levels = np.broadcast_to(artifact.inverse.measurement_noise_max, system.ny).tolist()
    xs, zs, levels, disturbances = [], [], [], []
    groups = np.array_split(np.arange(n), min(n, GROUPS))
    for i, group in enumerate(groups):
        count = len(group)
        positions = [(i + rng.random()) / len(groups)] * system.ny
        if system.ny > 1 and rng.random() >= ALIKE:
            positions[1:] = rng.random(system.ny - 1).tolist()
        level = tuple(
            largest * _part_of_largest(position - noise_free_share, noise_free_share, high_noise_emphasis)
            for position, largest in zip(positions, largest_levels, strict=True)
        )
        hold = int(rng.choice(HOLDS))
        amplitude = EXPLORATION * rng.random((count, 1))
        disturbance = 0.0
        if artifact.process_noise_max is not None and rng.random() < process_noise_share:
            disturbance = system.process_noise * float(np.sqrt(rng.random()))
        observer = KKLObserver(artifact, level, process_noise=disturbance)
        x = system.draw_starts(rng, count).T.copy()
        inside = np.ones(count, dtype=bool)
        x_rows, z_rows = np.empty((len(ages), count, system.nx)), np.empty((len(ages), count, artifact.filter.size))
        slot = {int(age): i for i, age in enumerate(ages)}
        w = np.zeros_like(x)
        u = np.zeros((count, system.nu))
        for k in range(steps + 1):
            y = noisy_output(system, x.T, measurement_noise=level, rng=rng)
            if k == 0:
                observer.reset(y)
            else:
                observer.advance(y, u)
            if k in slot:
                x_rows[slot[k]], z_rows[slot[k]] = x.T, observer.z
            if k % hold == 0:
                action = controller(observer.decode()) + amplitude * rng.uniform(-1, 1, (count, system.nu))
                u = np.clip(action, -1.0, 1.0) * u_max
            if disturbance:
                w = np.ascontiguousarray(draw_process_noise(system, disturbance, n=count, steps=1, rng=rng)[0].T)
            after = advance_batch(system, x, np.ascontiguousarray(u.T), w, dt)
            beyond = np.flatnonzero(~((after >= low) & (after <= high)).all(0))
            after = followed_rows(system, x, np.ascontiguousarray(u.T), w, dt=dt, end=after, rows=beyond)
            inside &= ((after >= low) & (after <= high)).all(0)
            x = np.where(inside, after, x)
        xs.append(x_rows[:, inside])
        zs.append(z_rows[:, inside])
        levels.append(np.tile(level, (int(inside.sum()), 1)))
        disturbances.append(np.full(int(inside.sum()), disturbance))
        report(int(group[-1]) + 1)
    kept = sum(map(len, levels))
    if 2 * kept < n:
        raise ValueError(
            f"of {n} trajectories under the controller only {kept} stayed within bounds = {system.bounds}; widen them, "
            "or shrink X"
        )
    parts = np.concatenate(xs, 1), np.concatenate(zs, 1), np.concatenate(disturbances), np.concatenate(levels)
    return ClosedLoop(ages, *parts)


def _part_of_largest(position: float, noise_free_share: float, high_noise_emphasis: float) -> float:
    """A level over two decades, as in :class:`training.maps.inverse.TrajectorySampler`; none at negative positions."""
    if position < 0:
        return 0.0
    return float(100 ** ((position / (1 - noise_free_share)) ** (1 / high_noise_emphasis) - 1))
