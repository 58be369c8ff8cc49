"""Pairs of state and filter state, along simulated trajectories."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kkl_gym.simulate import advance_batch, simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver, LinearFilter
from training.controllers import Controller
from training.signals import DRIVEN, KINDS, draw_process_noise, random_inputs

CHUNK = 500  # trajectories simulated at once
EXCITATION = 10.0  # seconds for which random inputs lead starts out of the training box
PUSH = 20.0  # seconds for which constant ones do
EXPLORATION = 0.5  # largest amplitude of what is added to a controller's action, in input bounds
HOLDS = (1, 5, 10, 20)  # samples for which actions are held
GROUPS = 50  # of closed-loop trajectories with a noise level and a time for which actions are held in common
QUIET = 0.2  # share of closed-loop trajectories without measurement noise
DISTURBED = 0.5  # share with process noise, where the map is told


@dataclass(frozen=True)
class Trajectories:
    """Trajectories of a system, measured without noise, with the filter running beside them from its own start.

    ages : samples since reset at which they were recorded, sorted, (m,).
    x : (m, n, nx).
    z : (m, n, size of the filter's state).
    process_noise : its level along each trajectory, (n,).
    """

    ages: np.ndarray
    x: np.ndarray
    z: np.ndarray
    process_noise: np.ndarray


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
    kinds: tuple[str, ...] = KINDS,
    excited: float = 0.0,
    push: float = 0.0,
    disturbed: float = 0.0,
) -> Trajectories:
    """Simulate n trajectories from starts in the training box, driven if the filter takes inputs.

    ``report`` is told how many there are so far; for the rest see :func:`trajectories`.
    """
    xs: list[np.ndarray] = []
    zs: list[np.ndarray] = []
    levels: list[np.ndarray] = []
    kinds = kinds if linear.nu else ()
    for x, u, level in trajectories(system, n, steps, linear.dt, rng, kinds, excited, push, disturbed):
        xs.append(x[ages])
        zs.append(run_filter(linear, output(system, x), u, ages))
        levels.append(level)
        report(sum(x.shape[1] for x in xs))
    return Trajectories(ages, np.concatenate(xs, 1), np.concatenate(zs, 1), np.concatenate(levels))


def trajectories(
    system: System,
    n: int,
    steps: int,
    dt: float,
    rng: np.random.Generator,
    kinds: tuple[str, ...] = (),
    excited: float = 0.0,
    push: float = 0.0,
    disturbed: float = 0.0,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """n trajectories from starts uniform in the training box, in chunks.

    States and inputs, (steps (+ 1), CHUNK, ...), and the level of process noise, (CHUNK,). Those that leave the
    declared bounds are replaced by new ones.

    kinds : of random inputs; without any, inputs have no columns.
    excited : share of the trajectories that start where inputs have led from X, if the system has any: beyond X.
    push : these inputs are constant, up to so many times their bounds, for PUSH seconds; or, if it is 0, random ones
        within their bounds, for EXCITATION seconds.
    disturbed : share of the trajectories with process noise, at any level up to the system's own, high ones more often.
    """
    kept = tried = 0
    while kept < n:
        count = min(CHUNK, n - kept)
        x0 = rng.uniform(*system.box(), (count, system.nx))
        if excited and system.nu:
            some = slice(0, round(excited * count))
            led = _led(system, x0[some], dt, rng, push)
            x0[some] = np.where(np.isfinite(led).all(-1)[:, None], led, x0[some])
        u = random_inputs(system, count, steps, dt, rng, kinds) if kinds else np.zeros((steps, count, 0))
        w, level = None, np.zeros(count)
        if disturbed and system.process_noise:
            level = system.process_noise * np.where(rng.random(count) < disturbed, np.sqrt(rng.random(count)), 0.0)
            w = draw_process_noise(system, level, count, steps, rng)
        x = simulate(system, x0, steps, dt, u=u if kinds else None, w=w)
        inside = np.isfinite(x[-1]).all(-1)
        kept += int(inside.sum())
        tried += count
        if tried > 20 * n:
            raise ValueError(
                f"of {tried} trajectories of {steps * dt:g} s only {kept} stayed within bounds = "
                f"{system.bounds}; widen the bounds, shrink X or shorten the trajectories"
            )
        yield x[:, inside], u[:, inside], level[inside]


def _led(system: System, x0: np.ndarray, dt: float, rng: np.random.Generator, push: float) -> np.ndarray:
    """Where inputs lead from starts (n, nx); NaN where that is out of bounds."""
    steps = round((PUSH if push else EXCITATION) / dt)
    if push:
        u = np.broadcast_to(push * rng.uniform(-1, 1, (len(x0), system.nu)) * system.u_max, (steps, len(x0), system.nu))
    else:
        u = random_inputs(system, len(x0), steps, dt, rng, DRIVEN)
    return np.asarray(simulate(system, x0, steps, dt, u=u)[-1])


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


@dataclass(frozen=True)
class ClosedLoop(Trajectories):
    """Trajectories under a controller that acts on an observer's estimate; z holds the noise that the observer saw.

    level : standard deviation of the measurement noise along each trajectory, (n,).
    """

    level: np.ndarray


def record_closed_loop(
    system: System,
    artifact: Artifact,
    controller: Controller,
    n: int,
    steps: int,
    ages: np.ndarray,
    rng: np.random.Generator,
    report: Callable[[int], None] = lambda done: None,
) -> ClosedLoop:
    """Simulate n trajectories from starts in the training box, in which the controller acts on x_hat, with exploration.

    Never on the true state: such inputs would tell the observer, which filters them, what it is to find out by itself.
    For the same reason noise is not added afterwards, but is what the observer and through it the controller saw.
    Groups of trajectories differ in noise level, a fifth having none, and in how long an action is held, and if the
    observer is told it in the level of process noise, half having none; rows in how much is added to an action.
    Trajectories that leave the declared bounds are dropped, so that there may be fewer than n.

    Raises ValueError if that happens to more than half of them.
    """
    dt = artifact.filter.dt
    low, high = (np.array(bound)[:, None] for bound in zip(*system.bounds, strict=True))
    u_max = np.array(system.u_max)
    xs, zs, levels, disturbances = [], [], [], []
    groups = np.array_split(np.arange(n), min(n, GROUPS))
    for i, group in enumerate(groups):
        count = len(group)
        position = ((i + rng.random()) / len(groups) - QUIET) / (1 - QUIET)
        level = 0.0 if position < 0 else float(artifact.inverse.noise_max * 100 ** (np.sqrt(position) - 1))
        hold = int(rng.choice(HOLDS))
        amplitude = EXPLORATION * rng.random((count, 1))
        disturbance = 0.0
        if artifact.process_max is not None and rng.random() < DISTURBED:
            disturbance = system.process_noise * float(np.sqrt(rng.random()))
        observer = KKLObserver(artifact, level, process_noise=disturbance)
        x = rng.uniform(*system.box(), (count, system.nx)).T.copy()
        inside = np.ones(count, dtype=bool)
        x_rows, z_rows = np.empty((len(ages), count, system.nx)), np.empty((len(ages), count, artifact.filter.size))
        slot = {int(age): i for i, age in enumerate(ages)}
        w = np.zeros_like(x)
        u = np.zeros((count, system.nu))
        for k in range(steps + 1):
            y = output(system, x.T) + level * rng.standard_normal((count, system.ny))
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
                w = np.ascontiguousarray(draw_process_noise(system, disturbance, count, 1, rng)[0].T)
            after = advance_batch(system, x, np.ascontiguousarray(u.T), w, dt)
            inside &= ((after >= low) & (after <= high)).all(0)
            x = np.where(inside, after, x)
        xs.append(x_rows[:, inside])
        zs.append(z_rows[:, inside])
        levels.append(np.full(int(inside.sum()), level))
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
