"""Pairs under a controller that acts on an observer's estimate."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.trajectories.motions import ALIKE, EXPLORATION, Pairs, draw_process_noise, noisy_output
from training.trajectories.policies import Controller

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

    The inputs of a controller that acts on the true state would show it to the observer, which filters them. For the
    same reason noise is not added afterwards: the controller acts on it too. Groups of trajectories differ in noise
    level, in how long an action is held, and in the level of process noise if the observer is given it. Pairs of a
    group differ in how much is added to an action.
    """
    largest = np.broadcast_to(artifact.inverse.measurement_noise_max, system.ny)
    groups = np.array_split(np.arange(n), min(n, GROUPS))
    parts = list[tuple[np.ndarray, ...]]()
    for i, group in enumerate(groups):
        positions = np.full(system.ny, (i + rng.random()) / len(groups))
        if system.ny > 1 and rng.random() >= ALIKE:
            positions[1:] = rng.random(system.ny - 1)
        level, loud = np.zeros(system.ny), positions >= noise_free_share
        along = (positions[loud] - noise_free_share) / (1 - noise_free_share)  # two decades, as in TrajectorySampler
        level[loud] = largest[loud] * 100 ** (along ** (1 / high_noise_emphasis) - 1)
        disturbance = 0.0
        if artifact.process_noise_max is not None and rng.random() < process_noise_share:
            disturbance = system.process_noise * float(np.sqrt(rng.random()))
        observer = KKLObserver(artifact, tuple(level.tolist()), process_noise=disturbance)
        x, z = _group(system, observer, controller, len(group), steps=steps, ages=ages, rng=rng)
        inside = np.isfinite(x[-1]).all(-1)
        kept = int(inside.sum())
        parts.append((x[:, inside], z[:, inside], np.full(kept, disturbance), np.tile(level, (kept, 1))))
        report(int(group[-1]) + 1)
    xs, zs, disturbances, levels = zip(*parts, strict=True)
    kept = sum(map(len, levels))
    if 2 * kept < n:
        raise ValueError(
            f"of {n} trajectories under the controller only {kept} stayed within bounds = {system.bounds}; widen them, "
            "or shrink X"
        )
    return ClosedLoop(
        ages, np.concatenate(xs, 1), np.concatenate(zs, 1), np.concatenate(disturbances), np.concatenate(levels)
    )


def _group(
    system: System,
    observer: KKLObserver,
    controller: Controller,
    n: int,
    *,
    steps: int,
    ages: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """States and filter states at the ages of n trajectories; states are NaN beyond the bounds."""
    level, u_max = observer.measurement_noise, np.array(system.u_max)
    hold, amplitude = int(rng.choice(HOLDS)), EXPLORATION * rng.random((n, 1))
    x0, u = system.draw_starts(rng, n), np.zeros((n, system.nu))
    w = draw_process_noise(system, observer.process_noise, n=n, steps=steps, rng=rng)
    zs, recorded = list[np.ndarray](), set(ages.tolist())

    def act(k: int, x: np.ndarray) -> np.ndarray:
        nonlocal u
        y = noisy_output(system, np.where(np.isfinite(x), x, system.X_centre), measurement_noise=level, rng=rng)
        if k == 0:
            observer.reset(y)
        else:
            observer.advance(y, u)
        if k in recorded:
            zs.append(observer.z.copy())
        if k % hold == 0:
            action = controller(observer.decode()) + amplitude * rng.uniform(-1, 1, (n, system.nu))
            u = np.clip(action, -1.0, 1.0) * u_max
        return u

    x = simulate(system, x0, steps, observer.artifact.filter.dt, u=act, w=w)
    act(steps, x[-1])
    return x[ages], np.stack(zs)
