"""Simulated motions that fit windows of records for given parameters, and the derivatives of their outputs."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kkl_gym.compiled import batch_step
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.trajectories.parameters import with_parameters

STEP = 1e-8  # step of numerical derivatives: in half-widths of X for a start, in Shooting.unit for a parameter
SETTLING = 12  # largest number of Levenberg-Marquardt steps that fit a start
CONVERGED = 1e-3  # a start has converged if a step lowers its mean squared residual by less than this share
FIRST_DAMPING = 1e-3  # damping of the first step, as a share of the diagonal of J'WJ
BEGINNINGS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)  # a start is fitted to these initial shares of its window in turn
DRAWS, KEPT = 64, 4  # random starts for each window, and the number of best ones that are fitted
SAMPLES_PER_STATE = 8  # least number of samples per state to which a start is fitted, because of noise
MOST_ROWS = 60_000  # largest number of motions in one simulation


@dataclass(frozen=True)
class Windows:
    """Equally long windows of records: ``y`` (steps + 1, n, ny), ``u`` (steps, n, nu) and starts ``x0`` (n, nx)."""

    y: np.ndarray
    u: np.ndarray
    x0: np.ndarray


class Shooting:
    """Outputs of a system as a function of its start and its unknown parameters, and the outputs' derivatives.

    The simulation's substeps suit ``system``, whose parameters must therefore be near the unknown ones. Shapes:
    ``unit`` (p,), the units of the parameters.
    """

    def __init__(self, system: System, dt: float, limits: Mapping[str, tuple[float, float]], unit: np.ndarray) -> None:
        self.system, self.dt, self.limits, self.unit, self.names = system, dt, limits, unit, tuple(limits)
        self.low, self.high = np.array(list(limits.values()), dtype=float).T
        self.half = np.array([(high - low) / 2 for low, high in system.X])
        self.given = np.array([system.parameters[name] for name in self.names])
        ranges = zip((self.given - unit).tolist(), (self.given + unit).tolist(), strict=True)
        self._both = _with_parameters(system, tuple(zip(self.names, ranges, strict=True)))
        self._step = batch_step(self._both)

    def around(self, theta: np.ndarray) -> "Shooting":
        """Return the same shooting for the system with the parameters ``theta`` (p,)."""
        system = self.system.replace(dict(zip(self.names, theta.tolist(), strict=True)))
        return Shooting(system, self.dt, self.limits, self.unit)

    def outputs(self, theta: np.ndarray, x0: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the outputs (steps + 1, n, ny) of motions with parameters (n, p), starts (n, nx) and inputs."""
        starts = np.concatenate([x0, theta], 1)
        parts = []
        for rows in np.array_split(np.arange(len(x0)), -(-len(x0) // MOST_ROWS)):
            held = u[:, rows] if u.shape[-1] else None
            x = simulate(self._both, starts[rows], len(u), self.dt, u=held, step=self._step)
            parts.append(self._both.output(x))
        return np.concatenate(parts, 1)

    def derivatives(
        self, theta: np.ndarray, x0: np.ndarray, u: np.ndarray, *, y: np.ndarray, parameters: bool = True
    ) -> np.ndarray:
        """Return derivatives (steps + 1, n, ny, d) of y by starts in half-widths, and by theta in ``unit`` if asked."""
        n, nx = x0.shape
        size = np.concatenate([self.half, self.unit]) * STEP
        moved = len(size) if parameters else nx
        at = np.concatenate([x0, np.tile(theta, (n, 1))], 1)
        flat = (at + np.diag(size)[:moved, None]).reshape(-1, len(size))
        beside = self.outputs(flat[:, nx:], flat[:, :nx], np.tile(u, (1, moved, 1)))
        return np.moveaxis((beside.reshape(len(y), moved, n, -1) - y[:, None]) / STEP, 1, -1)


# Each call of with_parameters makes a new class, which would be compiled again.
@functools.lru_cache(maxsize=8)
def _with_parameters(system: System, ranges: tuple[tuple[str, tuple[float, float]], ...]) -> System:
    return with_parameters(system, dict(ranges))


@dataclass
class Motions:
    """Motions from ``x0`` (n, nx): ``y``, residuals ``r`` (steps + 1, n, ny), weighted mean squares ``each`` (n,)."""

    x0: np.ndarray
    y: np.ndarray
    r: np.ndarray
    each: np.ndarray

    def take(self, others: "Motions", rows: np.ndarray, of: np.ndarray) -> None:
        """Replace the motions at the indices ``rows`` by those of ``others`` at the indices ``of``."""
        self.x0[rows], self.each[rows] = others.x0[of], others.each[of]
        self.y[:, rows], self.r[:, rows] = others.y[:, of], others.r[:, of]


class Problem:
    """The weighted least-squares problem of one set of windows."""

    def __init__(self, shooting: Shooting, windows: Windows, noise: np.ndarray | None = None) -> None:
        self.shooting, self.windows = shooting, windows
        spread = np.nanvar(windows.y.reshape(-1, windows.y.shape[-1]), axis=0) if noise is None else noise**2
        self.weight = 1.0 / np.where(spread > 0, spread, 1.0)
        low, high = np.array(shooting.system.bounds, dtype=float).T
        self.low, self.high = low + 1e-6 * (high - low), high - 1e-6 * (high - low)
        self.there = np.isfinite(windows.y)
        self.count = np.maximum(self.there.sum((0, 2)), 1)
        self.rows = np.arange(len(windows.x0))

    def follow(self, theta: np.ndarray, x0: np.ndarray, rows: np.ndarray) -> Motions:
        """Simulate some windows from starts ``x0``, which are first clipped to the bounds."""
        x0, there = np.clip(x0, self.low, self.high), self.there[:, rows]
        y = self.shooting.outputs(np.tile(theta, (len(x0), 1)), x0, self.windows.u[:, rows])
        r = np.where(there & np.isfinite(y), self.windows.y[:, rows] - y, 0.0)
        lost = (~np.isfinite(y) & there).any((0, 2))
        return Motions(x0, y, r, np.where(lost, np.inf, (r**2 * self.weight).sum((0, 2)) / self.count[rows]))

    def normal(
        self, theta: np.ndarray, at: Motions, rows: np.ndarray, *, parameters: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return J'WJ (m, d, d) and J'Wr (m, d) of some windows, by starts and, if ``parameters``, by parameters."""
        J = self.derivatives(theta, at, rows, parameters=parameters)
        Jw = J * self.weight[:, None]
        H = np.einsum("knya,knyb->nab", Jw, J, optimize=True)
        return H, np.einsum("knya,kny->na", Jw, at.r[:, rows], optimize=True)

    def derivatives(self, theta: np.ndarray, at: Motions, rows: np.ndarray, *, parameters: bool = True) -> np.ndarray:
        """Return J (steps + 1, m, ny, d) of some windows, zero where an output or a finite derivative is missing."""
        u = self.windows.u[:, rows]
        J = self.shooting.derivatives(theta, at.x0[rows], u, y=at.y[:, rows], parameters=parameters)
        there = self.there[:, rows][..., None] & np.isfinite(J).all(-1, keepdims=True)
        return np.where(there, J, 0.0)

    def settle(self, theta: np.ndarray, at: Motions, rows: np.ndarray, rounds: int) -> None:
        """Fit the starts of some windows, each separately, by Levenberg-Marquardt steps."""
        nx, damping = at.x0.shape[1], np.full(len(at.x0), FIRST_DAMPING)
        H, g = np.zeros((len(at.x0), nx, nx)), np.zeros((len(at.x0), nx))
        moved = rows = rows[np.isfinite(at.each[rows])]
        for _ in range(rounds):
            if not len(rows):
                return
            if len(moved):
                H[moved], g[moved] = self.normal(theta, at, moved, parameters=False)
            steps = np.linalg.solve(damped(H[rows], damping[rows]), g[rows, :, None])[..., 0]
            x0 = at.x0[rows] + self.shooting.half * steps
            tried = self.follow(theta, x0, rows)
            better = tried.each < at.each[rows]
            going = tried.each < (1.0 - CONVERGED) * at.each[rows]
            at.take(tried, rows[better], np.flatnonzero(better))
            damping[rows] *= np.where(better, 0.1, 10.0)
            moved, rows = rows[going], rows[going | ~better]

    def part(self, rows: np.ndarray, x0: np.ndarray, length: int | None = None) -> "Problem":
        """Return the same problem for some windows with starts ``x0``, cut to ``length`` steps unless it is None."""
        u = self.windows.u[:length, rows]
        return Problem(self.shooting, Windows(self.windows.y[: len(u) + 1, rows], u, x0), self.weight**-0.5)

    def beginnings(self) -> list[int]:
        """Return rising lengths (in steps) of the windows' beginnings, up to the whole windows."""
        steps, nx = len(self.windows.u), self.shooting.system.nx
        return sorted({min(max(round(part * steps), SAMPLES_PER_STATE * nx), steps) for part in (*BEGINNINGS, 1.0)})

    def searched(self, theta: np.ndarray, rng: np.random.Generator) -> Motions:
        """Return motions that fit the windows, found from random starts in X.

        The squared residuals of a long chaotic window have many minima; those of its beginning have few. A start is
        therefore fitted first to the beginning, and then to longer and longer parts of the window.
        """
        x0, (length, *longer) = self.windows.x0.copy(), self.beginnings()
        draws = self.shooting.system.draw_starts(rng, DRAWS)
        for rows in np.array_split(self.rows, -(-len(x0) * DRAWS // MOST_ROWS)):
            tried = self.part(np.repeat(rows, DRAWS), np.tile(draws, (len(rows), 1)), length)
            each = tried.follow(theta, tried.windows.x0, tried.rows).each.reshape(-1, DRAWS)
            kept = draws[np.argsort(each, 1)[:, :KEPT]].reshape(-1, x0.shape[1])
            at = self.part(np.repeat(rows, KEPT), kept, length).settled(theta)
            best = KEPT * np.arange(len(rows)) + at.each.reshape(-1, KEPT).argmin(1)
            x0[rows] = at.x0[best]
        at = self.part(self.rows, x0, length).settled(theta)
        for length in longer:
            at = self.part(self.rows, at.x0, length).settled(theta)
        return at

    def settled(self, theta: np.ndarray) -> Motions:
        """Return motions whose starts fit the windows best for the parameters ``theta``."""
        at = self.follow(theta, self.windows.x0, self.rows)
        self.settle(theta, at, self.rows, SETTLING)
        return at


def damped(H: np.ndarray, damping: "float | np.ndarray") -> np.ndarray:
    """Return the matrices (n, d, d) with a share of their diagonals added (Levenberg-Marquardt)."""
    diagonal = np.einsum("naa->na", H)
    more = np.reshape(damping, (-1, 1)) * diagonal + 1e-12 * diagonal.max(1, keepdims=True, initial=0.0) + 1e-30
    return H + more[:, :, None] * np.eye(H.shape[-1])
