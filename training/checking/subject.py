"""The system that is checked, with all that several checks look at: points, derivatives, motions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kkl_gym.compiled import SamplingStep, batch_step
from kkl_gym.equations import input_matrix
from kkl_gym.simulate import RATE_STEP, SubstepsError, simulate
from kkl_gym.system import System, rate_under
from training.trajectories.controllers import Controller
from training.trajectories.policy import under_policy
from training.trajectories.signals import DRIVEN, random_inputs

POINTS = 1000  # of X, of 2X and of the bounds
MOTIONS = 200  # that are followed
STEPS, FEWEST = 5000, 200  # substeps, and sampling intervals, of motions where no duration is given
FOLLOWED = 20  # motions by which substeps are counted
NUMERICAL_STEP = 1e-5  # of derivatives, in half-widths of X: cubes of it are as large as what rounding leaves


def of_X(system: System, n: int, factor: float = 1.0) -> np.ndarray:
    """Points of X or a multiple of it, (n, nx), the same each time."""
    return system.draw_starts(np.random.default_rng(1), n, factor)


def of_bounds(system: System, n: int) -> np.ndarray:
    """Points within the bounds, (n, nx); of 2X where not every point of a box is a state."""
    if type(system).draw_starts is not System.draw_starts:
        return of_X(system, n, 2.0)
    low, high = np.array(system.bounds, dtype=float).T
    return np.random.default_rng(2).uniform(low, high, (n, system.nx))


@dataclass(frozen=True)
class Motions:
    """Motions of several kinds. Shapes: ``x`` (steps + 1, n, nx), ``u`` (steps, n, nu)."""

    kinds: tuple[str, ...]
    x: np.ndarray
    u: np.ndarray

    @property
    def stays(self) -> np.ndarray:
        """Which of them stay within the bounds, (n,)."""
        return np.asarray(np.isfinite(self.x[-1]).all(-1))

    def rows(self, origin: str, kind: str | None = None) -> np.ndarray:
        """Which of them, (n,), start in X or in 2X, and are of a kind."""
        parts = [(one, start) for one in self.kinds for start in ("X", "2X")]
        wanted = [start == origin and kind in (None, one) for one, start in parts]
        return np.repeat(wanted, self.x.shape[1] // len(parts))


@dataclass(frozen=True)
class Subject:
    """A system and how it is sampled. What is random is the same each time."""

    system: System
    dt: float
    duration: float
    policy: Controller | None = None

    @property
    def step(self) -> SamplingStep[np.ndarray]:
        """What moves batches of it, compiled where it can be."""
        return batch_step(self.system)

    @cached_property
    def inner(self) -> np.ndarray:
        """Points of X, (POINTS, nx)."""
        return of_X(self.system, POINTS)

    @cached_property
    def outer(self) -> np.ndarray:
        """Points of 2X, (POINTS, nx)."""
        return of_X(self.system, POINTS, 2.0)

    @cached_property
    def everywhere(self) -> np.ndarray:
        """Points within the bounds, (POINTS, nx)."""
        return of_bounds(self.system, POINTS)

    @cached_property
    def half(self) -> np.ndarray:
        """Half-widths of X, (nx,)."""
        low, high = self.system.box()
        return np.asarray((high - low) / 2)

    @cached_property
    def rate(self) -> float:
        """How fast the system changes, in 1/s, where no better is known than the sampling."""
        try:
            return 1.0 / self.dt if self.system.discrete else self.system.typical_rate
        except ValueError:  # an integrator
            return 1.0 / self.duration

    def derivative(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The drift at ``x`` (n, nx) under ``u`` (n, nu): its mean over a sampling interval in discrete time."""
        system = self.system
        with np.errstate(all="ignore"):
            if system.discrete:
                moved = system.step(x.T, u.T)
                return np.array([np.broadcast_to(xi, len(x)) for xi in moved], dtype=float).T / self.dt - x / self.dt
            out = system.drift(x)
            if system.nu:
                rows = input_matrix(system, x.T)
                out = out + np.array([sum(gij * uj for gij, uj in zip(row, u.T)) for row in rows]).T
            return out

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """df/dx by central differences, with states in half-widths of X. Shapes: ``x`` (n, nx); returns (m, nx, nx)."""
        columns = []
        with np.errstate(all="ignore"):
            for j, half in enumerate(self.half):
                step = np.eye(self.system.nx)[j] * NUMERICAL_STEP * half
                columns.append((self.system.drift(x + step) - self.system.drift(x - step)) / (2 * NUMERICAL_STEP))
        found = np.stack(columns, axis=-1) / self.half[:, None]
        return np.asarray(found[np.isfinite(found).all((1, 2))])

    @cached_property
    def motions(self) -> Motions | SubstepsError:
        """Motions from X and from 2X, free ones and driven ones or those under the policy; or why there are none."""
        system, rng = self.system, np.random.default_rng(3)
        driven = ("driven",) if system.nu else ()
        kinds = ("under the policy",) if self.policy else ("free", *driven)
        n, steps = MOTIONS // (2 * len(kinds)), max(1, round(self.duration / self.dt))
        x0 = np.concatenate([system.draw_starts(rng, n, factor) for _ in kinds for factor in (1.0, 2.0)])
        try:
            if self.policy:
                own = np.arange(len(x0)) % 4 == 0
                return Motions(kinds, *under_policy(system, self.policy, x0, steps=steps, dt=self.dt, rng=rng, own=own))
            u = np.zeros((steps, len(x0), system.nu))
            if driven:
                u[:, 2 * n :] = random_inputs(system, 2 * n, steps, dt=self.dt, rng=rng, kinds=DRIVEN)
            return Motions(kinds, simulate(system, x0, steps, self.dt, u=u, step=self.step), u)
        except SubstepsError as error:
            return error

    @cached_property
    def staying(self) -> np.ndarray:
        """States along those motions from X that stay within the bounds, (steps + 1, n, nx)."""
        motions = self.motions
        if isinstance(motions, SubstepsError):
            return np.zeros((0, 0, self.system.nx))
        return motions.x[:, motions.stays & motions.rows("X")]

    def substeps(self, x: np.ndarray) -> np.ndarray:
        """Substeps (steps,) for ``x`` (steps, n, nx) under the largest input, not rounded, and one at least."""
        with np.errstate(all="ignore"):
            rate = rate_under(self.system, np.moveaxis(x, -1, 0), self.system.u_max)
            need = np.broadcast_to(rate, x.shape[:-1]) * self.dt / RATE_STEP
        return np.asarray(np.nan_to_num(need, nan=1.0, posinf=1.0).clip(1.0).mean(-1))

    def affordable(self) -> float:
        """The duration in seconds, or what STEPS substeps make of it along motions from X without input."""
        x, longest = of_X(self.system, FOLLOWED), min(STEPS, round(self.duration / self.dt))
        counted = np.ones(longest)
        for k in range(0, 0 if self.system.discrete else longest, FEWEST):
            if not len(x) or counted[:k].sum() >= STEPS:
                break
            try:
                motions = simulate(self.system, x, min(FEWEST, longest - k), self.dt, step=self.step)
            except SubstepsError:  # the check of the bounds says so
                break
            counted[k : k + FEWEST] = self.substeps(motions[:-1])
            x = motions[-1][np.isfinite(motions[-1]).all(-1)]
        return min(self.duration, self.dt * max(FEWEST, int((counted.cumsum() <= STEPS).sum())))
