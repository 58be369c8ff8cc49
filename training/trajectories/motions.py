"""Simulated motions under random inputs, policies and noise, and the filter's states beside them.

Process noise enters these motions; measurement noise enters the filter's state when :mod:`training.maps.inverse` draws
a batch.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from kkl_gym.simulate import Step, simulate
from kkl_gym.system import System
from observers import LinearFilter
from training.trajectories.filtering import filter_states
from training.trajectories.policies import Controller

KINDS = ("zero", "steps", "zero", "sine")
DRIVEN = ("steps", "sine", "pulses")
CHUNK = 500  # trajectories simulated at once
FIRST = 100  # trajectories tried, from which on a share of them must stay within the bounds
FEWEST_INSIDE = 0.05  # that share
# Seconds, at the pace of the shipped systems, for which inputs lead starts out of the training box.
RANDOM_LEAD_IN, CONSTANT_LEAD_IN = 10.0, 20.0
NEAR = 0.4  # share of the trajectories that start in X itself where others start in a larger box
POLICY_KINDS = ("steps", "sine")  # of a policy's errors and explorations
POLICY_ERROR = (0.02, 0.5)  # of the states that a policy acts on, in multiples of the system's scale
EXPLORATION = 0.5  # largest amplitude of the signal added to a policy's actions, in input bounds
# Every so many trajectories under a policy one is its own, the others are explored. On those alone the input tells the
# state, which an agent's does not. Under the regulator on x_hat, at the default noise, cart-pole's angle is estimated
# to 3.4 % of X's half-width with 4 here, to 3.2 % with 12 and to 3.1 % with none; by an exact EKF to 2.7 %.
POLICYS_OWN = 12


@dataclass(frozen=True)
class Pairs:
    """States and the filter's states beside them, at ages since the filter's start, measured without noise.

    Shapes: ``ages`` (m,) in samples, ``x`` (m, n, nx), ``z`` (m, n, size), ``process_noise`` (n,), ``nominal`` (n,).
    """

    ages: np.ndarray
    x: np.ndarray
    z: np.ndarray
    process_noise: np.ndarray
    nominal: np.ndarray | None = None


@dataclass(frozen=True)
class Motions:
    """How trajectories are started and driven, beside uniform starts in the training box."""

    kinds: tuple[str, ...] = ()
    lead_in_share: float = 0.0
    lead_in_input: float = 0.0
    process_noise_share: float = 0.0
    box_factor: float = 1.0
    policy: Controller | None = None


def random_inputs(
    system: System,
    n: int,
    steps: int,
    *,
    dt: float,
    rng: np.random.Generator,
    kinds: tuple[str, ...] = KINDS,
    bounds: Sequence[float] | None = None,
) -> np.ndarray:
    """Draw random signals (steps, n, k) within bounds (k,), by default those of the inputs; held between samples."""
    bounds = system.u_max if bounds is None else bounds
    out = np.zeros((steps, n, len(bounds)))
    t = np.arange(steps) * dt
    for row in range(n):
        kind = kinds[row % len(kinds)]
        for j, bound in enumerate(bounds):
            if kind in ("steps", "pulses"):
                hold = system.pace * np.exp(rng.uniform(np.log(0.05), np.log(5.0)))
                changes = rng.random(steps) < min(1.0, dt / hold)
                levels = rng.uniform(-bound, bound, steps + 1)
                out[:, row, j] = levels[np.cumsum(changes)]
                if kind == "pulses":
                    out[rng.integers(steps + 1) :, row, j] = 0.0
            elif kind == "sine":
                amplitude, phase = rng.uniform(0, bound), rng.uniform(0, 2 * np.pi)
                frequency = np.exp(rng.uniform(np.log(0.2), np.log(20.0))) / system.pace
                out[:, row, j] = amplitude * np.sin(frequency * t + phase)
    return out


def draw_process_noise(
    system: System, level: float | np.ndarray, *, n: int, steps: int, rng: np.random.Generator
) -> np.ndarray:
    """Process noise (steps, n, nx) of levels (n,), uniform in a box and held over each sampling interval."""
    bound = np.multiply.outer(level, system.scale)
    return np.asarray(bound * rng.uniform(-1.0, 1.0, (steps, n, system.nx)))


def under_policy(
    system: System,
    policy: Controller,
    x0: np.ndarray,
    *,
    steps: int,
    dt: float,
    rng: np.random.Generator,
    own: np.ndarray,
    w: np.ndarray | None = None,
    report: Callable[[int], object] | None = None,
    plant: System | None = None,
    step: Step | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate trajectories under a policy that errs about the state and explores, but for its ``own``.

    The input of a policy that acts on the true state would show the state to the observer, which filters that input.
    So each trajectory has an error of its own in the state that the policy sees, and a signal added to its actions.

    Shapes: ``x0`` (n, nx), ``own`` (n,), ``w`` (steps, n, nx); returns ``x`` (steps + 1, n, nx), ``u`` (steps, n, nu).
    """
    n, u_max = len(x0), np.array(system.u_max)
    signals = partial(random_inputs, system, n, steps, dt=dt, rng=rng, kinds=POLICY_KINDS)
    error = signals(bounds=system.scale)
    least, largest = np.log(POLICY_ERROR)
    error *= np.exp(rng.uniform(least, largest, n))[:, None]
    exploration = signals(bounds=(1.0,) * system.nu)
    exploration *= EXPLORATION * rng.random(n)[:, None]
    error[:, own] = exploration[:, own] = 0.0
    u = np.zeros((steps, n, system.nu))

    def act(k: int, x: np.ndarray) -> np.ndarray:
        seen = np.where(np.isfinite(x), x, system.X_centre) + error[k]  # what has escaped may do anything
        action = policy(seen)
        unknown = ~np.isfinite(action).all(-1)
        if unknown.any():
            at = int(unknown.argmax())
            raise ValueError(f"the policy gives the action {action[at].tolist()} at x = {seen[at].tolist()}")
        u[k] = np.clip(action + exploration[k], -1.0, 1.0) * u_max
        return u[k]

    return simulate(plant or system, x0, steps, dt, u=act, w=w, report=report, step=step), u


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
    motions: Motions,
    report: Callable[[float], object] = lambda done: None,
) -> Pairs:
    """Simulate trajectories and run the filter beside them; ``ages`` (m,)."""
    if not linear.nu:
        motions = dataclasses.replace(motions, kinds=(), policy=None)
    found, done = list[tuple[np.ndarray, np.ndarray, np.ndarray]](), 0
    for x, u, level in trajectories(system, n=n, steps=steps, dt=linear.dt, rng=rng, motions=motions, report=report):
        found.append((x[ages], filter_states(linear, system.output(x), u, ages), level))
        done += len(level)
        report(done)
    xs, zs, levels = zip(*found, strict=True)
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

    Shapes: returns ``x`` (steps + 1, at most CHUNK, nx), ``u`` (steps, at most CHUNK, nu), ``level`` (at most CHUNK,).
    """
    motions = motions or Motions()
    counts = [CHUNK] * (n // CHUNK) + [n % CHUNK]
    pending = [(row, row < round(motions.lead_in_share * count)) for count in counts for row in range(count)]
    tried = 0
    while pending:
        rows, pending = pending[:CHUNK], pending[CHUNK:]
        before = n - len(pending) - len(rows)
        x, u, level, inside = _simulated(
            system, rows, steps=steps, dt=dt, rng=rng, motions=motions, before=before, report=report
        )
        pending += [row for row, stayed in zip(rows, inside) if not stayed]
        tried += len(rows)
        if pending and tried >= FIRST:
            check_share(system, n - len(pending), tried, steps * dt)
        yield x[:, inside], u[:, inside], level[inside]


def _simulated(
    system: System,
    rows: list[tuple[int, bool]],
    *,
    steps: int,
    dt: float,
    rng: np.random.Generator,
    motions: Motions,
    before: int,
    report: Callable[[float], object],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Simulate a chunk of ``rows``, each the number of its input's kind and whether inputs lead its start from X.

    Returns states, inputs, levels of process noise, and which trajectories stay within the bounds.
    """
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

    def part(step: int) -> None:
        report(before + step * count / steps)

    if motions.policy:
        own = np.array([i % POLICYS_OWN == 0 for i, _ in rows])
        x, u = under_policy(system, motions.policy, x0, steps=steps, dt=dt, rng=rng, own=own, w=w, report=part)
    else:
        x = simulate(system, x0, steps, dt, u=u if motions.kinds else None, w=w, report=part)
    return x, u, level, np.isfinite(x[-1]).all(-1)


def check_share(system: System, stayed: int, tried: int, seconds: float) -> None:
    """Raise ValueError if hardly any of the trajectories that were tried stayed within the bounds."""
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
