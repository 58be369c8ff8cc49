"""The system that is checked, with all that several checks look at: points, derivatives, motions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kkl_gym.compiled import SamplingStep, batch_step
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.evaluation.levels import Level
from training.trajectories.motions import DRIVEN, random_inputs, under_policy
from training.trajectories.policies import Controller

POINTS = 1000  # of X, of 2X and of the bounds
MOTIONS = 100  # half of them driven, where there are inputs
NUMERICAL_STEP = 1e-5  # of derivatives, in half-widths of X: its cube is about double precision's rounding


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
class Subject:
    """A system and how it is sampled. What is random is the same each time."""

    system: System
    dt: float
    duration: float
    policy: Controller | None = None
    noise: tuple[Level, ...] = ()

    @cached_property
    def step(self) -> SamplingStep[np.ndarray]:
        """One sampling interval of a batch, compiled where it can be."""
        return batch_step(self.system)

    @cached_property
    def points(self) -> dict[str, np.ndarray]:
        """Points of X, of 2X and within the bounds, (POINTS, nx) each."""
        boxes = {"X": of_X(self.system, POINTS), "2X": of_X(self.system, POINTS, 2.0)}
        return {**boxes, "the bounds": of_bounds(self.system, POINTS)}

    @cached_property
    def half(self) -> np.ndarray:
        """Half-widths of X, (nx,)."""
        low, high = self.system.box()
        return np.asarray((high - low) / 2)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """df/dx, where finite, with states in half-widths of X. Shapes: ``x`` (n, nx); returns (m, nx, nx)."""
        found = self._difference(self.system.drift(self._around(x))) / self.half[:, None]
        return np.asarray(found[np.isfinite(found).all((1, 2))])

    def output_derivatives(self, x: np.ndarray) -> np.ndarray:
        """dh/dx, with states in half-widths of X. Shapes: ``x`` (..., nx); returns (..., ny, nx)."""
        return self._difference(self.system.output(self._around(x)))

    def step_derivatives(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Derivatives of a sampling interval, (..., nx, nx), in half-widths, at ``x`` (..., nx) under held inputs."""
        around, nu = self._around(x), u.shape[-1]
        flat = around.reshape(-1, x.shape[-1])
        held = np.broadcast_to(u[..., None, None, :], (*around.shape[:-1], nu)).reshape(1, len(flat), nu)
        moved = simulate(self.system, flat, 1, self.dt, u=held, step=self.step)[1]
        return self._difference(moved.reshape(around.shape)) / self.half[:, None]

    def _around(self, x: np.ndarray) -> np.ndarray:
        """Two points beside each state in each direction, (..., nx, 2, nx)."""
        steps = np.diag(NUMERICAL_STEP * self.half)
        return x[..., None, None, :] + np.stack([steps, -steps], axis=1)

    def _difference(self, values: np.ndarray) -> np.ndarray:
        """Derivatives (..., m, nx) from what is so (..., nx, 2, m) at the points of :meth:`_around`."""
        with np.errstate(invalid="ignore"):
            return np.moveaxis((values[..., 0, :] - values[..., 1, :]) / (2 * NUMERICAL_STEP), -2, -1)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of motions, with equal shares of them."""
        return ("under the policy",) if self.policy else ("free", "driven") if self.system.nu else ("free",)

    @cached_property
    def motions(self) -> tuple[np.ndarray, np.ndarray]:
        """Motions from X (steps + 1, MOTIONS, nx), NaN from where they leave the bounds, and their inputs."""
        system, rng, steps = self.system, np.random.default_rng(3), max(1, round(self.duration / self.dt))
        x0 = system.draw_starts(rng, MOTIONS)
        if self.policy:
            own = np.arange(MOTIONS) % 4 == 0
            return under_policy(system, self.policy, x0, steps=steps, dt=self.dt, rng=rng, own=own, step=self.step)
        u = np.zeros((steps, MOTIONS, system.nu))
        if system.nu:
            u[:, MOTIONS // 2 :] = random_inputs(system, MOTIONS // 2, steps, dt=self.dt, rng=rng, kinds=DRIVEN)
        return simulate(system, x0, steps, self.dt, u=u, step=self.step), u

    @cached_property
    def stays(self) -> np.ndarray:
        """Which motions stay within the bounds, (MOTIONS,)."""
        return np.asarray(np.isfinite(self.motions[0][-1]).all(-1))

    @property
    def staying_outputs(self) -> np.ndarray:
        """Outputs along these, (steps + 1, n, ny)."""
        return self.system.output(self.motions[0][:, self.stays])

    @property
    def followed(self) -> tuple[np.ndarray, np.ndarray]:
        """States and inputs along those of the first kind that stay within the bounds."""
        rows = np.flatnonzero(self.stays[: MOTIONS // len(self.kinds)])
        return self.motions[0][:, rows], self.motions[1][:, rows]
