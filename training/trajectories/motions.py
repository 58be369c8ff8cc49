"""Simulated motions under random inputs, policies and process noise, and noise-free filter states along them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from kkl_gym.simulate import Step, simulate
from kkl_gym.system import System
from kkl_gym.user_lines import user_line
from observers import LinearFilter
from training.trajectories.equations import linearised

Controller = Callable[[np.ndarray], np.ndarray]
"""Maps states (n, nx) to actions (n, nu) in [-1, 1]."""
Report = Callable[[float], object]  # called with the amount of work that is done
Chunk = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]

KINDS = ("zero", "steps", "zero", "sine")  # signals that the inputs of successive trajectories follow
DRIVEN = ("steps", "sine", "pulses")  # signals in place of KINDS if all trajectories shall have inputs
CHUNK = 500  # number of trajectories simulated at once
FIRST, FEWEST_INSIDE = 100, 0.05  # after FIRST trajectories, at least this share must have stayed within bounds
# Durations, in multiples of the system's pace, of lead-ins: inputs that lead starts out of X before a trajectory.
RANDOM_LEAD_IN, CONSTANT_LEAD_IN = 10.0, 20.0
FAR = 0.6  # share of the trajectories that start in the larger box, if there is one
INPUT_WEIGHT = 0.1  # a regulator's weight on inputs, relative to that on states, both scaled by typical sizes
POLICY_KINDS = ("steps", "sine")  # signals of a policy's errors and of its exploration
POLICY_ERROR = (0.02, 0.5)  # range of the bound, drawn per motion, of errors in states a policy sees, in System.scale
EXPLORATION = 0.5  # largest amplitude of the signal added to a policy's actions, in multiples of input bounds
# One in this many trajectories follows the policy exactly. The exact policy's input reveals the state; an agent's
# input, which depends on x_hat, does not. If a regulator acts on x_hat, at the default noise, the error of cart-pole's
# angle is 3.4 % of X's half-width with one in 4, 3.2 % with one in 12, and 3.1 % with none; an EKF has 2.7 %.
POLICYS_OWN = 12


@dataclass(frozen=True)
class Pairs:
    """States ``x`` (m, n, nx) of motions under ``process_noise`` (n,), and a filter's ``z`` (m, n, size) along them.

    ``ages`` (m,) are in samples since the filter's start; ``nominal`` (n,) marks motions with nominal parameters.
    """

    ages: np.ndarray
    x: np.ndarray
    z: np.ndarray
    process_noise: np.ndarray
    nominal: np.ndarray | None = None


@dataclass(frozen=True)
class Motions:
    """How trajectories start, and which inputs and process noise (of ``levels``, or of random levels) act on them."""

    system: System
    dt: float
    steps: int
    kinds: tuple[str, ...] = ()
    policy: Controller | None = None
    own: int = POLICYS_OWN
    process_noise_share: float = 0.0
    levels: tuple[float, ...] = ()
    box_factor: float = 1.0
    far: float = FAR
    lead_in_share: float = 0.0
    lead_in_input: float = 0.0

    def with_inputs(self, nu: int) -> "Motions":
        """Return the same motions if an observer takes inputs, else motions without inputs."""
        return self if nu else replace(self, kinds=(), policy=None)

    def beside(
        self,
        linear: LinearFilter,
        ages: np.ndarray,
        n: int,
        rng: np.random.Generator,
        report: Report = lambda done: None,
    ) -> Pairs:
        """Simulate trajectories and run the filter along them."""
        chunks = self.with_inputs(linear.nu).chunks(n, rng, report)
        x, z, level, _ = _together(
            (x[ages], filter_states(linear, self.system.output(x), u, ages), *rest) for x, u, *rest in chunks
        )
        return Pairs(ages, x, z, level)

    def drawn(self, n: int, rng: np.random.Generator, report: Report = lambda done: None) -> Chunk:
        """Concatenate all :meth:`chunks`."""
        return _together(self.chunks(n, rng, report))

    def chunks(self, n: int, rng: np.random.Generator, report: Report = lambda done: None) -> Iterator[Chunk]:
        """Simulate in chunks. For each trajectory that leaves the bounds, draw another with the same kind of inputs.

        Yields ``x`` (steps + 1, m, nx), ``u`` (steps, m, nu), the levels of process noise (m,), and a mask (m,)
        of the trajectories whose starts were drawn in X, even if then led out of X; m is up to CHUNK.
        """
        system, steps, pending, tried = self.system, self.steps, np.arange(n), 0
        while len(pending):
            rows, pending = pending[:CHUNK], pending[CHUNK:]
            count, before = len(rows), n - len(pending) - len(rows)
            x0, near = self._starts(rows, rng)
            part = partial(lambda before, count, k: report(before + k * count / steps), before, count)
            u = np.zeros((steps, count, 0))
            if self.kinds and not self.policy:
                kinds = [self.kinds[i % len(self.kinds)] for i in rows]
                u = random_inputs(system, count, steps, dt=self.dt, rng=rng, kinds=kinds)
            level = self._levels(count, rng)
            w = draw_process_noise(system, level, n=count, steps=steps, rng=rng) if level.any() else None
            if self.policy:
                how = {"steps": steps, "dt": self.dt, "rng": rng, "own": rows % self.own == 0}
                x, u = under_policy(system, self.policy, x0, **how, w=w, report=part)
            else:
                x = simulate(system, x0, steps, self.dt, u=u if self.kinds else None, w=w, report=part)
            inside = np.isfinite(x[-1]).all(-1)
            pending, tried = np.concatenate([pending, rows[~inside]]), tried + count
            stayed = n - len(pending)
            if len(pending) and tried >= FIRST and stayed < FEWEST_INSIDE * tried:
                few = f"of {tried} trajectories of {steps * self.dt:g} s only {stayed} stayed within bounds"
                raise ValueError(f"{few} = {system.bounds}; {how_to_stay(system, self.policy)}")
            report(stayed)
            yield x[:, inside], u[:, inside], level[inside], near[inside]

    def _levels(self, n: int, rng: np.random.Generator) -> np.ndarray:
        if self.levels:
            return rng.choice(self.levels, n)
        if not self.process_noise_share or not self.system.process_noise:
            return np.zeros(n)
        some = rng.random(n) < self.process_noise_share
        return np.asarray(self.system.process_noise * np.where(some, np.sqrt(rng.random(n)), 0.0))

    def _starts(self, rows: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return starts (n, nx), some in a larger box or led out of X by inputs, and a mask of those drawn in X."""
        system, share = self.system, self.lead_in_share
        x0, near = system.draw_starts(rng, len(rows)), np.ones(len(rows), dtype=bool)
        if self.box_factor > 1:
            near = rng.random(len(rows)) < 1 - self.far
            x0[~near] = system.draw_starts(rng, int((~near).sum()), self.box_factor)
        led = np.floor((rows + 1) * share) > np.floor(rows * share)
        if system.nu and led.any():
            constant, u_max = self.lead_in_input, np.array(system.u_max)
            steps = round((CONSTANT_LEAD_IN if constant else RANDOM_LEAD_IN) * system.pace / self.dt)
            kinds, bounds = (("constant",), constant * u_max) if constant else (DRIVEN, u_max)
            u = random_inputs(system, int(led.sum()), steps, dt=self.dt, rng=rng, kinds=kinds, bounds=bounds)
            end = simulate(system, x0[led], steps, self.dt, u=u)[-1]
            x0[led] = np.where(np.isfinite(end).all(-1)[:, None], end, x0[led])
        return x0, near


def _together(chunks: Iterator[Chunk]) -> Chunk:
    x, u, level, near = zip(*chunks, strict=True)
    return np.concatenate(x, 1), np.concatenate(u, 1), np.concatenate(level), np.concatenate(near)


def filter_states(linear: LinearFilter, y: np.ndarray, u: np.ndarray, ages: np.ndarray) -> np.ndarray:
    """Return the states (m, n, size), at distinct ages (m,) in samples, of a filter that starts at the first sample.

    Shapes: ``y`` (steps + 1, n, ny), ``u`` (steps, n, nu), where u[k] is held from y[k] to y[k + 1].
    """
    z = linear.start(y[0])
    out, slots = np.empty((len(ages), *z.shape)), {int(age): i for i, age in enumerate(ages)}
    for k in range(len(y)):
        z = linear.advance(z, y[k - 1], u[k - 1], y[k]) if k else z
        if k in slots:
            out[slots[k]] = z
    return out


def random_inputs(
    system: System,
    n: int,
    steps: int,
    *,
    dt: float,
    rng: np.random.Generator,
    kinds: Sequence[str] = KINDS,
    bounds: Sequence[float] | np.ndarray | None = None,
) -> np.ndarray:
    """Draw random signals (steps, n, k), held between samples, within bounds (k,), by default those of the inputs."""
    bounds = system.u_max if bounds is None else bounds
    out, t = np.zeros((steps, n, len(bounds))), np.arange(steps) * dt
    for row, j in np.ndindex(n, len(bounds)):
        kind, bound = kinds[row % len(kinds)], bounds[j]
        if kind in ("steps", "pulses"):
            hold = system.pace * np.exp(rng.uniform(np.log(0.05), np.log(5.0)))
            changes = rng.random(steps) < min(1.0, dt / hold)
            out[:, row, j] = rng.uniform(-bound, bound, steps + 1)[np.cumsum(changes)]
            if kind == "pulses":
                out[rng.integers(steps + 1) :, row, j] = 0.0
        elif kind == "sine":
            amplitude, phase = rng.uniform(0, bound), rng.uniform(0, 2 * np.pi)
            frequency = np.exp(rng.uniform(np.log(0.2), np.log(20.0))) / system.pace
            out[:, row, j] = amplitude * np.sin(frequency * t + phase)
        elif kind == "constant":
            out[:, row, j] = rng.uniform(-bound, bound)
    return out


def draw_process_noise(
    system: System, level: float | np.ndarray, *, n: int, steps: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw process noise (steps, n, nx) of levels (n,), uniform in a box and held over each sampling interval."""
    return np.asarray(np.multiply.outer(level, system.scale) * rng.uniform(-1.0, 1.0, (steps, n, system.nx)))


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
    """Simulate trajectories under a policy with errors in the state that it sees and with exploration.

    The exact policy's input would reveal the state to an observer, which filters that input. So all trajectories
    except those in the mask ``own`` have an error in the state that the policy sees, and a signal added to the actions.

    Shapes: ``x0`` (n, nx), ``own`` (n,), ``w`` (steps, n, nx); returns ``x`` (steps + 1, n, nx), ``u`` (steps, n, nu).
    """
    n, u_max = len(x0), np.array(system.u_max)
    signals = partial(random_inputs, system, n, steps, dt=dt, rng=rng, kinds=POLICY_KINDS)
    least, largest = np.log(POLICY_ERROR)
    error = signals(bounds=system.scale) * np.exp(rng.uniform(least, largest, n))[:, None]
    exploration = signals(bounds=(1.0,) * system.nu) * EXPLORATION * rng.random(n)[:, None]
    error[:, own] = exploration[:, own] = 0.0
    u = np.zeros((steps, n, system.nu))

    def act(k: int, x: np.ndarray) -> np.ndarray:
        seen = np.where(np.isfinite(x), x, system.X_centre) + error[k]  # after an escape the action is irrelevant
        action = policy(seen)
        for row in np.flatnonzero(~np.isfinite(action).all(-1)):
            raise ValueError(f"the policy gives the action {action[row].tolist()} at x = {seen[row].tolist()}")
        u[k] = np.clip(action + exploration[k], -1.0, 1.0) * u_max
        return u[k]

    return simulate(plant or system, x0, steps, dt, u=act, w=w, report=report, step=step), u


def recording_ages(steps: int, n: int) -> np.ndarray:
    """Return at most n ages in samples at which to record: half evenly spaced, half logarithmically for transients."""
    late = max(2, n - n // 2)  # number of evenly spaced ages, among them the first and the last
    ages = np.concatenate([np.geomspace(1, steps, n - late), np.linspace(0, steps, late)])
    return np.unique(ages.round()).astype(int)


def how_to_stay(system: System, policy: Controller | None) -> str:
    """Return advice for motions, perhaps under a policy, that leave the bounds."""
    if not system.nu:
        return "widen the bounds, shrink X, or shorten the motions"
    last = "reduce dt" if policy and not system.discrete else "give a policy that holds the system (--policy)"
    return f"widen the bounds, shrink X, shorten the motions, reduce u_max, or {last}"


def linear_quadratic(system: System, dt: float) -> Controller:
    """Return a saturated LQ regulator to the target, sampled at dt, with weights 1/scale^2 and INPUT_WEIGHT/u_max^2."""
    target, u_max = np.array(system.target), np.array(system.u_max)
    A, B, _ = linearised(system, system.target)
    Q, R = np.diag(1.0 / np.square(system.scale)), np.diag(INPUT_WEIGHT / u_max**2)
    if not system.discrete:
        held = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((system.nu, system.nx + system.nu))]]))
        A, B = held[: system.nx, : system.nx], held[: system.nx, system.nx :]
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return lambda x: np.clip(-(x - target) @ K.T / u_max, -1.0, 1.0)


def checked_policy(policy: Controller, system: System, name: str) -> Controller:
    """Return a policy that checks the shape of its actions; ValueError if its actions at drawn states are invalid."""
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs, so the policy {name!r} cannot act")

    def act(x: np.ndarray) -> np.ndarray:
        try:
            actions = np.asarray(policy(x), dtype=float)
        except Exception as error:  # a user's function may raise anything
            where = f" ({line})" if (line := user_line(error)) else ""
            raise ValueError(
                f"the policy {name!r} fails on states of shape {x.shape}: {type(error).__name__}: {error}{where}"
            ) from error
        if actions.shape != (len(x), system.nu):
            raise ValueError(
                f"the policy {name!r} must turn states of shape {x.shape} into actions of shape "
                f"{(len(x), system.nu)}, got {actions.shape}"
            )
        return actions

    x = system.draw_starts(np.random.default_rng(0), 20)
    actions = act(x)
    for row in np.flatnonzero(~(np.abs(actions) <= 1.0).all(-1)):
        raise ValueError(
            f"the policy {name!r} must return actions in [-1, 1], in multiples of u_max = {system.u_max}; "
            f"at x = {x[row].tolist()} it returns {actions[row].tolist()}"
        )
    return act
