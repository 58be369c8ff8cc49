"""Multiple shooting: Gauss-Newton steps fit a system's parameters and initial states to measured outputs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from training.identification.identifiability import PART, identifiable_directions
from training.identification.motions import FIRST_DAMPING, Motions, Problem, Shooting, Windows, damped

RESETTLING = 3  # largest number of steps that refit a start if its window fits worse after a step of the parameters
NONLINEAR = 0.3  # largest rms error of a predictable window's linearised outputs, in units of the noise
ROUNDS = 40  # largest number of Gauss-Newton steps at one length of windows
SLOW, PATIENCE = 0.1, 3  # a step that lowers chi-square per output by less is slow; PATIENCE of them in a row end a fit
SMALL_STEP = 0.05  # in standard errors: a shorter Gauss-Newton step ends the fit
EXACT = 1e-16  # a smaller mean square of residuals, relative to the outputs' variances, ends the fit
ROUNDING = 1e-14  # lower bound of Fit.noise, as a share of an output's standard deviation, or of a given noise
MOST_DAMPING = 1e9  # the fit ends if no step with a smaller damping lowers the residuals
CLUSTERS = 20  # least number of windows whose scatter gives standard errors
COLOURED = 1.5  # residuals are coloured if scatter raises a standard error by a larger factor, which chance hardly does
OUTLIER = 9.0  # a window is left out if its mean square exceeds the median by OUTLIER median absolute deviations


class UnexplainedError(ValueError):
    """Raised if the model explains no window of the records from the first guesses."""


@dataclass(frozen=True)
class Fit:
    """A least-squares fit: ``curvature`` is J'WJ, ``white`` and ``scattered`` are covariances of the gradient J'Wr.

    J has the outputs' derivatives by parameters, with refitted starts, W the weights. ``cost`` is the mean of W r^2,
    ``left`` the next Gauss-Newton step in standard errors. Shapes: ``theta`` (p,), ``residuals`` (steps + 1, n, ny),
    ``noise`` (ny,), the matrices (p, p), ``used`` (n,), ``starts_by_parameters`` (number used, nx, p).
    """

    shooting: Shooting
    theta: np.ndarray
    windows: Windows
    residuals: np.ndarray
    noise: np.ndarray
    curvature: np.ndarray
    white: np.ndarray
    scattered: np.ndarray
    used: np.ndarray
    cost: float
    left: float
    starts_by_parameters: np.ndarray

    def errors(self, directions: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return standard errors along directions: for white noise or by scatter of windows, whichever is larger.

        Residuals that are correlated by process noise make parameters less certain than white residuals of equal
        size. The scatter of the gradients of at least CLUSTERS windows accounts for the correlation (the sandwich
        estimator for clustered data). ``known`` spans the identifiable directions.

        Shapes: ``directions`` (p, k), ``known`` (p, m); returns (k,).
        """
        kinds = [self.white, self.scattered] if self.used.sum() >= CLUSTERS else [self.white]
        return np.max([self._errors(directions, known, kind) for kind in kinds], axis=0)

    def _errors(self, directions: np.ndarray, known: np.ndarray, kind: np.ndarray) -> np.ndarray:
        """Return the standard errors that follow from the covariance ``kind`` of the gradient."""
        inverse = np.linalg.pinv(known.T @ self.curvature @ known, rcond=1e-13, hermitian=True)
        spread = known @ inverse @ known.T @ directions
        return np.sqrt(np.maximum(np.einsum("ak,ab,bk->k", spread, kind, spread), 0.0))

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters by name."""
        return dict(zip(self.shooting.names, self.theta.tolist(), strict=True))

    @property
    def unit(self) -> np.ndarray:
        """Units (p,) of the parameters."""
        return self.shooting.unit

    @property
    def size(self) -> np.ndarray:
        """Absolute values (p,) of the parameters in their units, with 1 in place of 0."""
        values = np.abs(self.theta) / self.unit
        return np.where(values == 0, 1.0, values)

    @property
    def information(self) -> np.ndarray:
        """Fisher information (p, p) of the parameters in their units, for white noise."""
        return np.asarray(self.curvature @ np.linalg.pinv(self.white, rcond=1e-13, hermitian=True) @ self.curvature)

    @property
    def relative_information(self) -> np.ndarray:
        """Fisher information (p, p) of relative changes of the parameters."""
        return self.information * np.outer(self.size, self.size)

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors (p,) of the parameters, infinite for those that are not identifiable."""
        known = identifiable_directions(self.relative_information)
        unidentifiable = 1.0 - (known**2).sum(1) > PART**2
        errors = self.errors(np.eye(len(self.unit)), known * self.size[:, None])
        return np.where(unidentifiable, np.inf, self.unit * errors)

    @property
    def coloured(self) -> bool:
        """Whether the windows' gradients scatter more than white residuals explain."""
        known = identifiable_directions(self.information)
        return bool((self.errors(known, known) > COLOURED * self._errors(known, known, self.white)).any())


def predictable(fit: Fit, windows: Windows) -> np.ndarray:
    """Return a mask (n,) of the windows whose outputs respond linearly to parameter changes of one standard error.

    Changes are cut to one ``Shooting.unit`` where standard errors are larger. Long windows of a chaotic motion do not
    respond linearly: their squared residuals have many minima, and the curvature at a minimum gives no standard errors.
    """
    shooting, theta, problem = fit.shooting, fit.theta, Problem(fit.shooting, windows)
    at = problem.settled(theta)
    J = problem.derivatives(theta, at, problem.rows)
    _, beyond, by_parameters = _beyond_starts(J, problem.weight, at.x0.shape[1])
    linear = np.isfinite(at.each)
    known = identifiable_directions(fit.information)
    for change in (known * np.minimum(fit.errors(known, known), 1.0)).T:
        x0 = at.x0 + shooting.half * (by_parameters @ change)
        off = problem.follow(theta + change * shooting.unit, x0, problem.rows).y - at.y - beyond @ change
        off = np.where(problem.there, off, 0.0) / fit.noise
        linear &= np.sqrt((off**2).sum((0, 2)) / problem.count) < NONLINEAR
    return linear


def explained(each: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of the windows that are no outliers, given the mean squares ``each`` (n,) of residuals."""
    median = np.median(each)
    deviation = np.median(np.abs(each[np.isfinite(each)] - median)) if np.isfinite(median) else 0.0
    return np.isfinite(each) & (each <= median + OUTLIER * deviation)


def shoot(
    shooting: Shooting,
    theta: np.ndarray,
    windows: Windows,
    *,
    precision: float = SMALL_STEP,
    rounds: int = ROUNDS,
    noise: Sequence[float] | None = None,
    report: Callable[[float], object] = lambda part: None,
) -> Fit:
    """Fit parameters, and starts of windows of one length, by least squares; ``report`` receives the share done.

    Windows that the model explains much worse than most are left out. If the model is accurate for some motions and
    rough for others, as models of friction are, pass the noise's standard deviations as ``noise``. A window then has
    the weight 1 / (1 + c), with c its residuals' mean square in units of the noise. Steps then leave out only
    windows whose motions leave the bounds; the standard errors of the Fit still leave out outliers (``Fit.used``).
    """
    deviations = None if noise is None else np.asarray(noise, dtype=float)
    if deviations is not None and (deviations.shape != windows.y.shape[-1:] or not (deviations > 0).all()):
        raise ValueError(f"noise must be {windows.y.shape[-1]} positive numbers, one for each output, got {noise}")
    problem = Problem(shooting, windows, deviations)
    nx, damping, slow = shooting.system.nx, FIRST_DAMPING, 0
    # The weight 1 / (1 + c) is the derivative of the loss log(1 + c).
    loss = np.log1p if noise is not None else np.asarray
    fits = explained if noise is None else np.isfinite
    at = problem.settled(theta)
    for done in range(rounds):
        report(done / rounds)
        used = fits(at.each)
        if not used.any():
            low, high = np.min(windows.x0, axis=0), np.max(windows.x0, axis=0)
            raise UnexplainedError(
                f"windows of {len(windows.u)} samples: all motions leave the bounds of {shooting.system.name}, from "
                f"first guesses of the state between {np.round(low, 3)} and {np.round(high, 3)} and of the parameters "
                f"{dict(zip(shooting.names, theta.round(6).tolist()))}; pass other first guesses or limits"
            )
        H, g = problem.normal(theta, at, problem.rows, parameters=True)
        cost = at.each[used].mean()
        if noise is not None:
            share = 1.0 / (1.0 + at.each)
            H, g, cost = H * share[:, None, None], g * share[:, None], 1.0
        if cost < EXACT:
            break
        better, rests = False, _left(*_reduced(H, g, used=used, nx=nx)[:2], cost) < precision
        while not rests and not better and damping < MOST_DAMPING:
            S, s, along = _reduced(H, g, used=used, nx=nx, damping=damping)
            step = np.linalg.lstsq(S + damping * np.diag(S.diagonal()), s, rcond=1e-12)[0]
            new = np.clip(theta + step * shooting.unit, shooting.low, shooting.high)
            change = (new - theta) / shooting.unit
            x0 = at.x0 + (along[..., -1] - along[..., :-1] @ change) * shooting.half
            tried = problem.follow(new, x0, problem.rows)
            problem.settle(new, tried, np.flatnonzero(tried.each > at.each), RESETTLING)
            # Mean squares are bounded, as a step that suits all other windows may make a chaotic one diverge.
            worst = np.minimum(tried.each[used], 2 * at.each[used].max())
            fall = loss(at.each[used]).sum() - loss(worst).sum()
            better = fall > 0
            damping = max(damping / 10.0, 1e-12) if better else damping * 10.0
        if better:
            theta, at = new, tried
            gained = fall * len(windows.y) / cost
            slow = slow + 1 if gained < SLOW else 0
            rests = gained < precision**2 or slow == PATIENCE
        if rests or not better:
            break
    return _fit(problem, theta, at, explained(at.each))


def _reduced(
    H: np.ndarray, g: np.ndarray, *, used: np.ndarray, nx: int, damping: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the normal equations S (p, p), s (p,) of the parameters after the starts' elimination (Schur complement).

    The third array, A (n, nx, p + 1), gives the starts' steps: A[..., -1] - A[..., :-1] @ the parameters' step.
    """
    D, cross = damped(H[:, :nx, :nx], damping), H[:, nx:, :nx]
    along = np.linalg.solve(D, np.concatenate([H[:, :nx, nx:], g[:, :nx, None]], -1))
    S = (H[:, nx:, nx:] - cross @ along[..., :-1])[used].sum(0)
    return S, (g[:, nx:] - (cross @ along[..., -1:])[..., 0])[used].sum(0), along


def _left(S: np.ndarray, s: np.ndarray, cost: float) -> float:
    """Return the length of a Gauss-Newton step in standard errors; ``cost`` is the mean square of the residuals."""
    step = np.linalg.lstsq(S, s, rcond=1e-12)[0]
    return float(np.sqrt(max(step @ s, 0.0) / max(cost, 1e-300)))


def _fit(problem: Problem, theta: np.ndarray, at: Motions, used: np.ndarray) -> Fit:
    shooting, nx = problem.shooting, at.x0.shape[1]
    J = problem.derivatives(theta, at, np.flatnonzero(used))
    there = problem.there[:, used] & (J != 0).any(-1)
    count = there.sum((0, 1))
    # The fitted starts leave this share of the degrees of freedom.
    free = 1.0 - min(nx * used.sum() / max(count.sum(), 1), 0.9)
    squares = np.where(there, at.r[:, used] ** 2, 0.0).sum((0, 1)) / np.maximum(count, 1) / free
    noise = np.sqrt(np.maximum(squares, ROUNDING**2 / problem.weight))
    curvature, beyond, by_parameters = _beyond_starts(J, problem.weight, nx)
    gradients = np.einsum("knyp,kny->np", beyond, at.r[:, used] * problem.weight)
    # At the minimum the gradients add up to zero, so over few windows their scatter is too small.
    few = len(gradients) / max(len(gradients) - len(theta), 1)
    return Fit(
        shooting=shooting,
        theta=theta,
        windows=replace(problem.windows, x0=at.x0),
        residuals=np.where(problem.there, at.r, np.nan),
        noise=noise,
        curvature=curvature.sum(0),
        white=np.einsum("knya,knyb,y->ab", beyond, beyond, (problem.weight * noise) ** 2, optimize=True),
        scattered=few * gradients.T @ gradients,
        used=used,
        cost=float(np.mean(at.each[used])),
        left=_left(curvature.sum(0), gradients.sum(0), np.mean(at.each[used])),
        starts_by_parameters=by_parameters,
    )


def _beyond_starts(J: np.ndarray, weight: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, with starts refitted to the parameters, J'WJ (n, p, p), J, and the starts' derivatives (n, nx, p)."""
    H = np.einsum("knya,knyb,y->nab", J, J, weight, optimize=True)
    by_parameters = -np.linalg.pinv(H[:, :nx, :nx], rcond=1e-13, hermitian=True) @ H[:, :nx, nx:]
    beyond = J[..., nx:] + np.einsum("knyx,nxp->knyp", J[..., :nx], by_parameters)
    curvature = np.einsum("knya,knyb,y->nab", beyond, beyond, weight, optimize=True)
    return curvature, beyond, by_parameters
