"""Pairs of state and filter state, recorded along simulated trajectories."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import LinearFilter
from training.trajectories.noise import draw_process_noise
from training.trajectories.signals import DRIVEN, KINDS, random_inputs

CHUNK = 500  # trajectories simulated at once
RANDOM_LEAD_IN = 10.0  # seconds for which random inputs lead starts out of the training box
CONSTANT_LEAD_IN = 20.0  # seconds for which constant ones do


@dataclass(frozen=True)
class Trajectories:
    """Trajectories of a system, measured without noise, with the filter running beside them from its own start.

    ages : samples since reset at which they were recorded, sorted, (m,).
    x : (m, n, nx).
    z : (m, n, size of the filter's state).
    process_noise : its level along each trajectory, (n,), in multiples of the system's scale per second.
    """

    ages: np.ndarray
    x: np.ndarray
    z: np.ndarray
    process_noise: np.ndarray


@dataclass(frozen=True)
class Motions:
    """What trajectories are drawn from, beside uniform starts in the training box.

    kinds : of random inputs, see :func:`training.trajectories.signals.random_inputs`; without any, there are no inputs.
    lead_in_share : share of the trajectories that start where inputs have led from X, if the system has any: beyond X.
    lead_in_input : these inputs are constant, up to so many times their bounds, for CONSTANT_LEAD_IN seconds; or, if it
        is 0, random ones within their bounds, for RANDOM_LEAD_IN seconds.
    process_noise_share : share of the trajectories with process noise, at any level up to the system's own, high ones
        more often.
    """

    kinds: tuple[str, ...] = ()
    lead_in_share: float = 0.0
    lead_in_input: float = 0.0
    process_noise_share: float = 0.0


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
    *,
    n: int,
    steps: int,
    ages: np.ndarray,
    rng: np.random.Generator,
    motions: Motions | None = None,
    report: Callable[[int], None] = lambda done: None,
) -> Trajectories:
    """Simulate n trajectories and run the filter beside them.

    ``motions`` are undriven if the filter takes no inputs; None is all kinds of inputs. ``report`` is told how many
    there are so far; for the rest see :func:`trajectories`.
    """
    motions = motions or Motions(kinds=KINDS)
    if not linear.nu:
        motions = dataclasses.replace(motions, kinds=())
    xs: list[np.ndarray] = []
    zs: list[np.ndarray] = []
    levels: list[np.ndarray] = []
    for x, u, level in trajectories(system, n=n, steps=steps, dt=linear.dt, rng=rng, motions=motions):
        xs.append(x[ages])
        zs.append(linear.run(system.output(x), u, ages))
        levels.append(level)
        report(sum(x.shape[1] for x in xs))
    return Trajectories(ages, np.concatenate(xs, 1), np.concatenate(zs, 1), np.concatenate(levels))


def trajectories(
    system: System,
    *,
    n: int,
    steps: int,
    dt: float,
    rng: np.random.Generator,
    motions: Motions | None = None,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """n trajectories from starts in the training box, in chunks.

    States and inputs, (steps (+ 1), CHUNK, ...), and the level of process noise, (CHUNK,). Those that leave the
    declared bounds are replaced by new ones of the same kind: driven alike, and led from X or not.

    ``motions`` None is the plainest: no inputs, no process noise, starts in X.

    Raises ValueError if hardly any stays within the bounds.
    """
    motions = motions or Motions()
    tried, pending = 0, []
    for count in [CHUNK] * (n // CHUNK) + [n % CHUNK]:
        pending += [(row, row < round(motions.lead_in_share * count)) for row in range(count)]
    while pending:
        rows, pending = pending[:CHUNK], pending[CHUNK:]
        count, led = len(rows), np.array([led for _, led in rows])
        x0 = rng.uniform(*system.box(), (count, system.nx))
        if system.nu and led.any():
            end = _lead_in(system, x0[led], dt, rng, motions.lead_in_input)
            x0[led] = np.where(np.isfinite(end).all(-1)[:, None], end, x0[led])
        u = np.zeros((steps, count, 0))
        if motions.kinds:
            u = random_inputs(
                system, count, steps, dt, rng, tuple(motions.kinds[i % len(motions.kinds)] for i, _ in rows)
            )
        w, level = None, np.zeros(count)
        if motions.process_noise_share and system.process_noise:
            some = rng.random(count) < motions.process_noise_share
            level = system.process_noise * np.where(some, np.sqrt(rng.random(count)), 0.0)
            w = draw_process_noise(system, level, count, steps, rng)
        x = simulate(system, x0, steps, dt, u=u if motions.kinds else None, w=w)
        inside = np.isfinite(x[-1]).all(-1)
        pending += [row for row, stayed in zip(rows, inside) if not stayed]
        tried += count
        if pending and tried > 20 * n:
            raise ValueError(
                f"of {tried} trajectories of {steps * dt:g} s only {n - len(pending)} stayed within bounds = "
                f"{system.bounds}; widen the bounds, shrink X or shorten the trajectories"
            )
        yield x[:, inside], u[:, inside], level[inside]


def _lead_in(system: System, x0: np.ndarray, dt: float, rng: np.random.Generator, constant: float) -> np.ndarray:
    """Where inputs lead from starts (n, nx); NaN where that is out of bounds."""
    steps = round((CONSTANT_LEAD_IN if constant else RANDOM_LEAD_IN) / dt)
    if constant:
        values = constant * rng.uniform(-1, 1, (len(x0), system.nu)) * system.u_max
        u = np.broadcast_to(values, (steps, len(x0), system.nu))
    else:
        u = random_inputs(system, len(x0), steps, dt, rng, DRIVEN)
    return np.asarray(simulate(system, x0, steps, dt, u=u)[-1])
