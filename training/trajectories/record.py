"""Pairs of state and filter state, recorded along simulated trajectories."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import LinearFilter
from training.trajectories.controllers import Controller
from training.trajectories.noise import draw_process_noise
from training.trajectories.policy import under_policy
from training.trajectories.signals import DRIVEN, KINDS, random_inputs

CHUNK = 500  # trajectories simulated at once
FIRST = 100  # trajectories tried before all others
FEWEST_INSIDE = 0.05  # share of them that must stay within the bounds
# Seconds, at the pace of the shipped systems, for which inputs lead starts out of the training box.
RANDOM_LEAD_IN, CONSTANT_LEAD_IN = 10.0, 20.0
# Every so many trajectories under a policy one is its own, the others are explored. On those alone the input tells the
# state, which an agent's does not. Under the regulator on x_hat, at the default noise, cart-pole's angle is estimated
# to 3.4 % of X's half-width with 4 here, to 3.2 % with 12 and to 3.1 % with none; by an exact EKF to 2.7 %.
POLICYS_OWN = 12
NEAR = 0.4  # share of the trajectories that start in X itself where others start in a larger box


@dataclass(frozen=True)
class Pairs:
    """States and the filter's states beside them, at ages since the filter's start, measured without noise.

    Shapes: ``ages`` (m,) in samples, ``x`` (m, n, nx), ``z`` (m, n, size), ``process_noise`` (n,), ``nominal`` (n,).
    """

    ages: np.ndarray
    x: np.ndarray
    z: np.ndarray
    process_noise: np.ndarray
    nominal: np.ndarray | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class Motions:
    """What trajectories are drawn from, beside uniform starts in the training box."""

    kinds: tuple[str, ...] = ()
    lead_in_share: float = 0.0
    lead_in_input: float = 0.0
    process_noise_share: float = 0.0
    box_factor: float = 1.0
    policy: Controller | None = None


def recording_ages(steps: int, n: int) -> np.ndarray:
    """Ages, n at most, at which to record: half of them even in the logarithm, which catches the transient."""
    late = max(2, n - n // 2)  # the first and the greatest age at least
    even = np.linspace(0, steps, late).round()
    early = np.geomspace(1, steps, n - late).round()
    return np.unique(np.concatenate([early, even])).astype(int)


def record(
    system: System,
    linear: LinearFilter,
    *,
    n: int,
    steps: int,
    ages: np.ndarray,
    rng: np.random.Generator,
    motions: Motions | None = None,
    report: Callable[[float], object] = lambda done: None,
) -> Pairs:
    """Simulate trajectories and run the filter beside them. Shapes: ``ages`` (m,)."""
    motions = motions or Motions(kinds=KINDS)
    if not linear.nu:
        motions = dataclasses.replace(motions, kinds=(), policy=None)
    xs: list[np.ndarray] = []
    zs: list[np.ndarray] = []
    levels: list[np.ndarray] = []
    for x, u, level in trajectories(system, n=n, steps=steps, dt=linear.dt, rng=rng, motions=motions, report=report):
        xs.append(x[ages])
        zs.append(linear.run(system.output(x), u, ages))
        levels.append(level)
        report(sum(x.shape[1] for x in xs))
    return Pairs(ages, np.concatenate(xs, 1), np.concatenate(zs, 1), np.concatenate(levels))


def trajectories(
    system: System,
    *,
    n: int,
    steps: int,
    dt: float,
    rng: np.random.Generator,
    motions: Motions | None = None,
    report: Callable[[float], object] = lambda done: None,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Simulate trajectories from starts in the training box, in chunks.

    Those that leave the system's bounds are replaced by new ones of the same kind: driven alike, and led from X or not.
    Starts and process noise are drawn anew.

    Shapes: returns ``x`` (steps + 1, at most CHUNK, nx), ``u`` (steps, at most CHUNK, nu), ``level`` (at most CHUNK,).
    """
    motions = motions or Motions()
    tried, pending = 0, []
    for count in [CHUNK] * (n // CHUNK) + [n % CHUNK]:
        pending += [(row, row < round(motions.lead_in_share * count)) for row in range(count)]
    if n > CHUNK:  # whether they stay within bounds is said before so many have been simulated
        first = _simulated(system, pending[:FIRST], steps=steps, dt=dt, rng=np.random.default_rng(0), motions=motions)
        check_share(system, int(first.inside.sum()), len(first.inside), steps * dt)
    while pending:
        rows, pending = pending[:CHUNK], pending[CHUNK:]
        told = partial(_tell, report, n - len(pending) - len(rows), len(rows) / steps)
        found = _simulated(system, rows, steps=steps, dt=dt, rng=rng, motions=motions, report=told)
        pending += [row for row, stayed in zip(rows, found.inside) if not stayed]
        tried += len(rows)
        if pending and tried >= FIRST:
            check_share(system, n - len(pending), tried, steps * dt)
        yield found.x[:, found.inside], found.u[:, found.inside], found.level[found.inside]


def _tell(report: Callable[[float], object], there: int, each: float, interval: int) -> None:
    """Tell how many trajectories are there: some, and a part of each that is under way."""
    report(there + each * interval)


@dataclass(frozen=True)
class _Chunk:
    """Pairs, and which of them stayed within the bounds."""

    x: np.ndarray
    u: np.ndarray
    level: np.ndarray
    inside: np.ndarray


def _simulated(
    system: System,
    rows: list[tuple[int, bool]],
    *,
    steps: int,
    dt: float,
    rng: np.random.Generator,
    motions: Motions,
    report: Callable[[int], object] | None = None,
) -> _Chunk:
    """Simulate trajectories of the kinds that the rows say: the number of the input's kind, and whether led from X."""
    count, led = len(rows), np.array([beyond for _, beyond in rows])
    x0 = system.draw_starts(rng, count)
    if motions.box_factor > 1:
        far = rng.random(count) >= NEAR
        x0[far] = system.draw_starts(rng, int(far.sum()), motions.box_factor)
    if system.nu and led.any():
        end = _lead_in(system, x0[led], dt=dt, rng=rng, constant=motions.lead_in_input)
        x0[led] = np.where(np.isfinite(end).all(-1)[:, None], end, x0[led])
    u = np.zeros((steps, count, 0))
    if motions.kinds and not motions.policy:
        kinds = tuple(motions.kinds[i % len(motions.kinds)] for i, _ in rows)
        u = random_inputs(system, count, steps, dt=dt, rng=rng, kinds=kinds)
    w, level = None, np.zeros(count)
    if motions.process_noise_share and system.process_noise:
        some = rng.random(count) < motions.process_noise_share
        level = system.process_noise * np.where(some, np.sqrt(rng.random(count)), 0.0)
        w = draw_process_noise(system, level, n=count, steps=steps, rng=rng)
    if motions.policy:
        own = np.array([i % POLICYS_OWN == 0 for i, _ in rows])
        x, u = under_policy(system, motions.policy, x0, steps=steps, dt=dt, rng=rng, own=own, w=w, report=report)
    else:
        x = simulate(system, x0, steps, dt, u=u if motions.kinds else None, w=w, report=report)
    return _Chunk(x, u, level, np.isfinite(x[-1]).all(-1))


def check_share(system: System, stayed: int, tried: int, seconds: float) -> None:
    """Raise an error if hardly any of the trajectories that were tried stayed within the bounds."""
    if stayed < FEWEST_INSIDE * tried:
        raise ValueError(
            f"of {tried} trajectories of {seconds:g} s only {stayed} stayed within bounds = {system.bounds}; widen the "
            "bounds, shrink X or shorten the trajectories, or give a policy that holds the system (--policy)"
        )


def _lead_in(system: System, x0: np.ndarray, *, dt: float, rng: np.random.Generator, constant: float) -> np.ndarray:
    """Where inputs lead from starts (n, nx); NaN where that is out of bounds."""
    steps = round((CONSTANT_LEAD_IN if constant else RANDOM_LEAD_IN) * system.pace / dt)
    if constant:
        values = constant * rng.uniform(-1, 1, (len(x0), system.nu)) * system.u_max
        u = np.broadcast_to(values, (steps, len(x0), system.nu))
    else:
        u = random_inputs(system, len(x0), steps, dt=dt, rng=rng, kinds=DRIVEN)
    return np.asarray(simulate(system, x0, steps, dt, u=u)[-1])
