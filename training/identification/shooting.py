"""Parameters of a system, and starts, that explain measured outputs: multiple shooting by Gauss-Newton."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.trajectories.parameters import with_parameters

STEP = 1e-6  # of a state's half-width, or of a parameter's unit, in numerical derivatives
ROUNDS = 40  # Gauss-Newton steps at one length of windows
CONVERGED = 1e-3  # fall of a window's mean square, relative, below which its start is done with
SMALL_STEP = 0.02  # of the standard errors, below which the parameters are done with
FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e9
OUTLIER = 9.0  # median deviations from the median that a window's mean square may have
MOST_ROWS = 60_000  # motions simulated at once


@dataclass(frozen=True)
class Windows:
    """Equally long stretches of records, each with a start of its own.

    Parameters
    ----------
    y : ndarray, shape (steps + 1, n, ny)
        Measured outputs; NaN where one is missing.
    u : ndarray, shape (steps, n, nu)
        Inputs that acted.
    x0 : ndarray, shape (n, nx)
        Estimates of the state at their starts.
    record : ndarray of int, shape (n,)
        Of which record each is.
    """

    y: np.ndarray
    u: np.ndarray
    x0: np.ndarray
    record: np.ndarray


@dataclass(frozen=True)
class Fit:
    """What shooting found.

    Parameters
    ----------
    parameters : dict of str to float
        The parameters that were unknown.
    windows : Windows
        With the starts found.
    residuals : ndarray, shape (steps + 1, n, ny)
        Measured minus predicted outputs; NaN where one is missing or a motion left the bounds.
    noise : ndarray, shape (ny,)
        Their standard deviations.
    information : ndarray, shape (p, p)
        Fisher information of the parameters in units of ``unit``, where starts are unknown.
    unit : ndarray, shape (p,)
        Of each parameter.
    used : ndarray of bool, shape (n,)
        Windows that the model explains; the others count little or nothing.
    cost : float
        Mean square of the residuals of those windows, over each output's variance.
    """

    parameters: dict[str, float]
    windows: Windows
    residuals: np.ndarray
    noise: np.ndarray
    information: np.ndarray
    unit: np.ndarray
    used: np.ndarray
    cost: float


class Shooting:
    """The least squares of one set of windows.

    Parameters
    ----------
    system : System
        The model, whose other parameters are right.
    dt : float
        Sampling interval in seconds.
    limits : mapping of str to (float, float)
        Lowest and highest value of each unknown parameter.
    unit : ndarray, shape (p,)
        Size of a change of each parameter.
    """

    def __init__(self, system: System, dt: float, limits: Mapping[str, tuple[float, float]], unit: np.ndarray) -> None:
        self.system, self.dt, self.unit, self.names = system, dt, unit, tuple(limits)
        self.low, self.high = np.array(list(limits.values()), dtype=float).T
        self.half = np.array([(high - low) / 2 for low, high in system.X])

    def outputs(self, theta: np.ndarray, x0: np.ndarray, u: np.ndarray, steps: int) -> np.ndarray:
        """Predicted outputs (steps + 1, n, ny) of motions with parameters (n, p) and starts (n, nx)."""
        ranges = {
            name: (value - unit, value + unit)
            for name, value, unit in zip(self.names, theta.mean(0), self.unit, strict=True)
        }
        both = with_parameters(self.system.replace(dict(zip(self.names, theta.mean(0), strict=True))), ranges)
        starts = np.concatenate([x0, theta], 1)
        parts = []
        for rows in np.array_split(np.arange(len(x0)), -(-len(x0) // MOST_ROWS)):
            x = simulate(both, starts[rows], steps, self.dt, u=u[:, rows] if u.shape[-1] else None)
            parts.append(both.output(x))
        return np.concatenate(parts, 1)

    def derivatives(
        self, theta: np.ndarray, x0: np.ndarray, u: np.ndarray, *, of_starts_only: bool = False, steps: int | None = None
    ) -> np.ndarray:
        """Derivatives (steps + 1, n, ny, nx + p) by starts, over X's half-widths, and parameters, over their units."""
        n, nx = x0.shape
        size = np.concatenate([self.half, self.unit]) * STEP
        moved = nx if of_starts_only else len(size)
        at = np.concatenate([x0, np.tile(theta, (n, 1))], 1)
        shifts = np.concatenate([np.diag(size)[:moved], -np.diag(size)[:moved]])
        flat = (at + shifts[:, None]).reshape(-1, len(size))
        y = self.outputs(flat[:, nx:], flat[:, :nx], np.tile(u, (1, 2 * moved, 1)), u.shape[0])
        y = y.reshape(len(y), 2, moved, n, -1)
        return np.moveaxis((y[:, 0] - y[:, 1]) / (2 * STEP), 1, -1)


class _Windows:
    """Least squares of one set of windows: their residuals, and steps of parameters and starts."""

    def __init__(self, shooting: Shooting, windows: Windows) -> None:
        self.shooting, self.data = shooting, windows
        spread = np.nanvar(windows.y.reshape(-1, windows.y.shape[-1]), axis=0)
        self.weight = 1.0 / np.where(spread > 0, spread, 1.0)
        low, high = np.array(shooting.system.bounds, dtype=float).T
        self.low, self.high = low + 1e-6 * (high - low), high - 1e-6 * (high - low)
        self.there = np.isfinite(windows.y)
        self.count = np.maximum(self.there.sum((0, 2)), 1)

    def residuals(self, theta: np.ndarray, x0: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals, zero where nothing was measured, and each window's mean square; inf where it leaves the bounds."""
        n, there = len(x0), self.there[:, rows]
        y = self.shooting.outputs(np.tile(theta, (n, 1)), x0, self.data.u[:, rows], len(self.data.y) - 1)
        lost = (~np.isfinite(y) & there).any((0, 2))
        r = np.where(there & np.isfinite(y), self.data.y[:, rows] - y, 0.0)
        each = (r**2 * self.weight).sum((0, 2)) / self.count[rows]
        return r, np.where(lost, np.inf, each)

    def normal(self, J: np.ndarray, r: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """J'J (n, d, d) and J'r (n, d) of each window."""
        there = self.there[:, rows][..., None] & np.isfinite(J).all(-1, keepdims=True)
        J = np.where(there, J, 0.0)
        Jw = J * self.weight[:, None]
        H = np.einsum("knya,knyb->nab", Jw, J, optimize=True)
        return H, np.einsum("knya,kny->na", Jw, r, optimize=True)

    def settle(self, theta: np.ndarray, x0: np.ndarray, rounds: int) -> np.ndarray:
        """Starts (n, nx) that fit best with these parameters, each window by itself, from given ones."""
        nx, half = self.shooting.system.nx, self.shooting.half
        x0, damping = x0.copy(), np.full(len(x0), FIRST_DAMPING)
        rows = np.arange(len(x0))
        r, each = self.residuals(theta, x0, rows)
        for _ in range(rounds):
            J = self.shooting.derivatives(theta, x0[rows], self.data.u[:, rows], of_starts_only=True)
            H, g = self.normal(J, r, rows)
            tried, better = x0[rows], np.zeros(len(rows), dtype=bool)
            for _ in range(3):
                D = H + damping[rows, None, None] * np.einsum("naa->na", H)[:, :, None] * np.eye(nx)
                change = np.linalg.solve(D + 1e-12 * np.eye(nx), g[..., None])[..., 0]
                tried = np.where(better[:, None], tried, np.clip(x0[rows] + change * half, self.low, self.high))
                r_new, each_new = self.residuals(theta, tried, rows)
                better = each_new < each[rows]
                damping[rows] *= np.where(better, 0.1, 10.0)
                if better.all():
                    break
            fall = np.where(better, 1.0 - each_new / np.maximum(each[rows], 1e-300), 0.0)
            x0[rows[better]], each[rows[better]] = tried[better], each_new[better]
            going = (fall > CONVERGED) & better
            rows, r = rows[going], r_new[:, going]
            if not len(rows):
                break
        return x0


def explained(each: np.ndarray) -> np.ndarray:
    """Which windows a model explains, by the mean squares of their residuals."""
    median = np.median(each)
    deviation = np.median(np.abs(each[np.isfinite(each)] - median)) if np.isfinite(median) else 0.0
    return np.isfinite(each) & (each <= median + OUTLIER * deviation)


def shoot(
    shooting: Shooting,
    theta: np.ndarray,
    windows: Windows,
    *,
    report: Callable[[str], object] = lambda line: None,
) -> Fit:
    """Least squares over parameters and starts at one length of windows.

    Parameters
    ----------
    shooting : Shooting
        The problem.
    theta : ndarray, shape (p,)
        Parameters to begin with.
    windows : Windows
        The data, with starts to begin with.
    report : callable, optional
        Told a line after each step.

    Returns
    -------
    Fit
        What was found.
    """
    problem, nx, p = _Windows(shooting, windows), shooting.system.nx, len(theta)
    everything = np.arange(len(windows.x0))
    x0, damping = problem.settle(theta, windows.x0, 8), FIRST_DAMPING
    r, each = problem.residuals(theta, x0, everything)
    for _ in range(ROUNDS):
        used = explained(each)
        J = shooting.derivatives(theta, x0, windows.u)
        H, g = problem.normal(J, r, everything)
        step, better = np.inf, False
        while damping < MOST_DAMPING:
            D = H + damping * np.einsum("naa->na", H)[:, :, None] * np.eye(nx + p) + 1e-12 * np.eye(nx + p)
            along = np.linalg.solve(D[:, :nx, :nx], np.concatenate([D[:, :nx, nx:], g[:, :nx, None]], -1))
            cross = D[:, nx:, :nx]
            S = (D[:, nx:, nx:] - cross @ along[..., :-1])[used].sum(0)
            s = (g[:, nx:] - (cross @ along[..., -1:])[..., 0])[used].sum(0)
            new = np.clip(theta + np.linalg.lstsq(S, s, rcond=1e-12)[0] * shooting.unit, shooting.low, shooting.high)
            change = (new - theta) / shooting.unit
            moved = x0 + (along[..., -1] - along[..., :-1] @ change) * shooting.half
            x0_new = problem.settle(new, np.clip(moved, problem.low, problem.high), 2)
            r_new, each_new = problem.residuals(new, x0_new, everything)
            still = used & np.isfinite(each_new)
            # Windows that chaos has thrown off count no more than they would if they were not explained.
            most = np.max(each[used])
            if np.minimum(np.where(np.isfinite(each_new), each_new, np.inf), 2 * most)[used].sum() < each[used].sum():
                noise = each[used].mean()
                step = float(np.sqrt(max(change @ S @ change, 0.0) / max(noise, 1e-300)))
                theta, x0, r, each, better = new, x0_new, r_new, each_new, True
                damping = max(damping / 10.0, 1e-12)
                break
            damping *= 10.0
        report(
            f"{dict(zip(shooting.names, theta.round(6).tolist(), strict=True))} cost {np.median(each):.5g} used {used.mean():.3f} "
            f"step {step:.3g} damping {damping:.1g}"
        )
        if not better or step < SMALL_STEP:
            break
    return _fit(shooting, theta, replace(windows, x0=x0), r, each)


def _fit(shooting: Shooting, theta: np.ndarray, windows: Windows, r: np.ndarray, each: np.ndarray) -> Fit:
    nx, used = shooting.system.nx, explained(each)
    J = shooting.derivatives(theta, windows.x0, windows.u)
    there = np.isfinite(windows.y) & np.isfinite(J).all(-1) & used[:, None]
    count = there.sum((0, 1))
    free = 1.0 - min(nx * used.sum() / max(count.sum(), 1), 0.9)  # degrees of freedom that starts leave
    noise = np.sqrt(np.where(there, r**2, 0.0).sum((0, 1)) / np.maximum(count, 1) / free)
    Jw = np.where(there[..., None], J, 0.0) / np.maximum(noise, 1e-300)[:, None]
    H = np.einsum("knya,knyb->nab", Jw[:, used], Jw[:, used], optimize=True)
    cross = H[:, nx:, :nx]
    by_starts = np.linalg.pinv(H[:, :nx, :nx], rcond=1e-13, hermitian=True)
    information = (H[:, nx:, nx:] - cross @ by_starts @ cross.transpose(0, 2, 1)).sum(0)
    found = dict(zip(shooting.names, theta.tolist(), strict=True))
    residuals = np.where(np.isfinite(windows.y), r, np.nan)
    return Fit(found, windows, residuals, noise, information, shooting.unit, used, float(np.mean(each[used])))
