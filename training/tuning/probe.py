"""Choosing the spectrum of A by the error that the best decoder would leave, without training any."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy

from kkl_gym.simulate import Step, simulate
from kkl_gym.system import System
from training.evaluation.levels import Level
from training.filter_noise import noise_covariance
from training.kalman import unknown_start
from training.neighbours import RESOLUTION
from training.seeds import Stream, generator
from training.spectrum import Spectrum, bessel_spectrum
from training.trajectories.controllers import Controller
from training.trajectories.derivatives import evaluate, jacobian, with_sensitivity
from training.trajectories.policy import under_policy
from training.trajectories.record import POLICYS_OWN

REAL_MODES = 24  # in the library
FREQUENCIES = np.array([0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.98, 0.999])  # quantiles of the power of y
DECAYS = 5  # of pairs at each frequency
LEAST_GAIN = 0.01  # by which one more mode must lower the error
SIGNIFICANT = 1e-13  # what rounding leaves of a matrix of unit diagonal
FARTHEST = 1e5  # that an error in the start may grow; what is known of it is a matrix of squares
SHORTEST = 10  # samples that must be followed
SMALLEST = 1e-9  # size of a state, in the largest's, below which errors are no longer taken relative to it
MIXED = 10.0  # largest half-width of X, in the smallest, beyond which states are taken to have different units


@dataclass(frozen=True)
class Choice:
    """A spectrum with the error that is predicted for it."""

    spectrum: Spectrum
    error: float
    kind: str = "chosen"


@dataclass
class Probe:
    """What the outputs of a system tell of its state through filters with any spectrum, to first order.

    Along motions from X, a small error d in the start moves the state by Phi d and, as filters are linear, their z by
    what they make of the signal dh/dx Phi d. From z with Gaussian errors of covariance R and a start of covariance S,
    the start is therefore known to (Z^T R^-1 Z + S^-1)^-1, and the state to that carried along by Phi. No decoder of
    this z does better, as far as motions are linear in their starts; an extended Kalman filter, which needs no filter
    but the equations, has R of the outputs themselves.

    R is the noise's exact covariance at each time since reset, and RESOLUTION^2 of the signal's for the network.

    Where X's half-widths differ by more than MIXED, states are taken in units of them. |x| is the distance from
    ``system.X_centre``.
    """

    system: System
    dt: float = 0.01
    duration: float = 50.0
    motions: int = 40
    seed: int = 0
    start: Spectrum = field(default_factory=Spectrum)
    step: Step | None = None
    policy: Controller | None = None

    def __post_init__(self) -> None:
        if not 0 < self.dt < self.duration < np.inf or self.motions < 2:
            raise ValueError(
                f"dt = {self.dt} must be positive, duration = {self.duration} longer, and motions = {self.motions} at "
                "least 2"
            )
        system, nx = self.system, self.system.nx
        rng = generator(Stream.TUNING, self.seed)
        x0 = system.draw_starts(rng, 2 * self.motions)
        steps, u = round(self.duration / self.dt), None
        if self.policy is None:
            last = simulate(system, x0, steps, self.dt, step=self.step)[-1]
        else:
            own = np.arange(len(x0)) % POLICYS_OWN == 0
            x, u = under_policy(system, self.policy, x0, steps=steps, dt=self.dt, rng=rng, own=own)
            last = x[-1]
        inside = np.isfinite(last).all(-1)
        if 2 * inside.sum() < self.motions:
            raise ValueError(
                f"of {len(x0)} motions from X only {inside.sum()} stayed within the bounds; widen the bounds, shrink X "
                "or shorten the motions, or give a policy that holds the system (--policy)"
            )
        x0, u = x0[inside][: self.motions], None if u is None else u[:, inside][:, : self.motions]
        low, high = system.box()
        half = (high - low) / 2
        self._unit = half if half.max() > MIXED * half.min() else np.ones(nx)
        identity = np.tile(np.eye(nx).ravel(), (len(x0), 1))
        joint = simulate(with_sensitivity(system, driven=u is not None), np.hstack([x0, identity]), steps, self.dt, u=u)
        # Where motions part, later times depend on the start beyond what double precision can tell.
        growth = np.abs(joint[..., nx:]) * np.divide.outer(self._unit, self._unit).T.ravel()
        useful = np.isfinite(joint).all((1, 2)) & (growth.max((1, 2)) < FARTHEST)
        end = len(joint) if useful.all() else int(useful.argmin())
        if end < SHORTEST:
            raise ValueError(
                f"only {end - 1} samples of {self.dt:g} s can be followed, of a duration of {self.duration:g} s: take "
                "a longer one, or a smaller dt"
            )
        self.x, self.Phi = joint[:end, :, :nx], joint[:end, :, nx:].reshape(end, -1, nx, nx)
        self.y = system.output(self.x)
        self.signal = evaluate(jacobian(system.h, nx), self.x) @ self.Phi
        self._known = np.linalg.inv(unknown_start(system)[1])
        early, late = np.geomspace(5, end - 1, 16).round(), np.linspace(0, end - 1, 32).round()
        self.ages = np.unique(np.concatenate([early, late])).astype(int)
        self.share = np.gradient(self.ages.astype(float))
        second_half = np.where(self.ages > end / 2, self.share, 0.0)  # what comes later is like it
        self.share += second_half / second_half.sum() * max(0, steps - (end - 1))
        self.share /= self.share.sum()

    @cached_property
    def _of_library(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.response(self.start + self.library)

    @cached_property
    def library(self) -> Spectrum:
        """The modes to choose from: real ones up to three times the system's rate, and pairs where y has its power."""
        slowest, fastest = 5.0 / self.duration, min(3.0 * self.system.typical_rate, 0.5 / self.dt)
        real = -np.geomspace(slowest, max(fastest, 2.0 * slowest), REAL_MODES)
        pairs = [(-a, w) for w in self.frequencies for a in np.geomspace(slowest, max(2 * w, 2 * slowest), DECAYS)]
        return Spectrum(tuple(map(_rounded, real)), tuple((_rounded(a), _rounded(w)) for a, w in pairs))

    @cached_property
    def frequencies(self) -> np.ndarray:
        """Where the outputs have their power, in rad/s: quantiles of it, rising; none where they do not move."""
        moving = self.y[..., self.y.std((0, 1)) > 0]
        if not moving.size:
            return np.empty(0)
        frequency, power = scipy.signal.periodogram(moving - moving.mean(0), 1.0 / self.dt, "hann", axis=0)
        share = np.cumsum((power.mean(1) / power.sum(0).mean(0)).mean(-1))
        at = 2 * np.pi * np.interp(FREQUENCIES, share / share[-1], frequency)
        return np.unique([_rounded(w) for w in at if w > 0])

    def response(self, spectrum: Spectrum) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """z, its derivatives by the start and the noise's covariance, by age, of the filter with some spectrum."""
        linear = spectrum.filter(self.system.ny, self.dt)
        steps, n, ny, nx = self.signal.shape
        signals = np.moveaxis(self.signal, -1, 2).reshape(steps, n * nx, ny)
        z = linear.run(self.y, np.zeros((steps - 1, n, 0)), self.ages)
        Z = linear.run(signals, np.zeros((steps - 1, n * nx, 0)), self.ages)
        return z, Z.reshape(len(self.ages), n, nx, linear.size), noise_covariance(linear, self.ages).sum(1)

    def error(self, spectrum: Spectrum, measurement_noise: Level) -> float:
        """Predict the error of the best decoder."""
        return self._relative(self._information(*self.response(spectrum), measurement_noise))

    def least(self, measurement_noise: Level) -> float:
        """Predict the error of whoever knows the equations and remembers every sample of y."""
        return self._relative(self._all_information(measurement_noise))

    def error_of_states(self, spectrum: Spectrum | None, measurement_noise: Level) -> np.ndarray:
        """Predict the error of the best decoder, or the least possible, for each state."""
        if spectrum is None:
            information = self._all_information(measurement_noise)
        else:
            information = self._information(*self.response(spectrum), measurement_noise)
        return np.asarray(self.share @ np.linalg.norm(self._left(information), axis=-1).mean(1))

    def unknown_of_starts(self, measurement_noise: Level) -> np.ndarray:
        """Predict what all of y leaves unknown of where a run started: a covariance (nx, nx)."""
        known = np.linalg.cholesky(self._known).T
        root = known @ _inverse_root(self._all_information(measurement_noise)[-1] + self._known)
        return np.asarray((root @ root.mT).mean(0))

    def _information(self, z: np.ndarray, Z: np.ndarray, P: np.ndarray, measurement_noise: Level) -> np.ndarray:
        """What z tells of the start, (ages, motions, nx, nx), from what :meth:`response` returns."""
        spread = np.cov(z.reshape(-1, z.shape[-1]).T).reshape(z.shape[-1], -1)
        levels = np.broadcast_to(np.asarray(measurement_noise, dtype=float), (self.system.ny,))
        levels = np.repeat(levels, z.shape[-1] // self.system.ny)
        R = np.multiply.outer(levels, levels) * P + RESOLUTION**2 * spread
        seen = Z @ _inverse_root(R)[:, None]
        return np.asarray(seen @ seen.mT)

    def _all_information(self, measurement_noise: Level) -> np.ndarray:
        """What all of y tells of the start, (ages, motions, nx, nx)."""
        levels = np.broadcast_to(np.asarray(measurement_noise, dtype=float), (self.system.ny,))
        if not (levels > 0).all():
            raise ValueError("without noise, all of y tells the state exactly")
        signal = self.signal / levels[:, None]
        return np.asarray(np.einsum("tnij,tnik->tnjk", signal, signal).cumsum(0)[self.ages])

    def _left(self, information: np.ndarray) -> np.ndarray:
        """Roots of the states' covariances, (ages, motions, nx, nx), from what is known of the start beside X."""
        return np.asarray(self.Phi[self.ages] @ _inverse_root(information + self._known))

    def _relative(self, information: np.ndarray) -> float:
        """The mean error in percent."""
        left = self._left(information) / self._unit[:, None]
        size = np.linalg.norm((self.x[self.ages] - self.system.X_centre) / self._unit, axis=-1)
        relative = np.linalg.norm(left, axis=(-2, -1)) / np.maximum(size, SMALLEST * size.max())
        found = float(100.0 * self.share @ np.minimum(relative, 2.0).mean(1))
        if not np.isfinite(found):
            raise FloatingPointError(f"the predicted error of {self.system.name} is no number")
        return found

    def choose(self, measurement_noise: Level, most: int = 21, anew: bool = False) -> list[Choice]:
        """Choose spectra of more and more modes, each the one before and the mode, or pair, that helps most."""
        z, Z, P = self._of_library
        ny, everything = self.system.ny, self.start + self.library
        size, n = everything.modes, len(everything.eigenvalues)
        parts = [(Spectrum((value,)), [i]) for i, value in enumerate(everything.eigenvalues)]
        parts += [(Spectrum((), (pair,)), [n + 2 * i, n + 2 * i + 1]) for i, pair in enumerate(everything.pairs)]
        first = [*range(len(self.start.eigenvalues)), *range(n, n + 2 * len(self.start.pairs))]
        parts = [part for part in parts if part[1][0] not in first]

        def error_of(columns: list[int]) -> float:
            taken = np.add.outer(size * np.arange(ny), columns).ravel()
            return self._relative(
                self._information(z[..., taken], Z[..., taken], P[:, taken[:, None], taken], measurement_noise)
            )

        chosen, columns, found = Spectrum(), list[int](), list[Choice]()
        before = self._relative(np.zeros(self.Phi[self.ages].shape))
        if first and not anew:
            chosen, columns, before = self.start, first, error_of(first)
            found.append(Choice(chosen, before))
            given = {*chosen.eigenvalues, *chosen.pairs}  # none of them twice
            parts = [part for part in parts if given.isdisjoint((*part[0].eigenvalues, *part[0].pairs))]
        while True:
            tried = []
            for spectrum, own in parts:
                if chosen.modes + spectrum.modes > most or own[0] in columns:
                    continue
                error = error_of([*columns, *own])
                tried.append((np.log(before / error) / spectrum.modes, error, spectrum, own))
            if not tried:
                return found
            gain, error, spectrum, own = max(tried, key=lambda one: one[0])
            if found and gain < LEAST_GAIN:
                return found
            chosen, columns, before = chosen + spectrum, columns + own, error
            found.append(Choice(chosen, error))

    def bessel(self, measurement_noise: Level, orders: Sequence[int], cutoffs: Iterable[float]) -> list[Choice]:
        """Find Bessel filters to compare with."""
        found, cutoffs = [], list(cutoffs)
        for order in orders:
            options = []
            for cutoff in cutoffs:
                spectrum = bessel_spectrum(order, cutoff)
                options.append(Choice(spectrum, self.error(spectrum, measurement_noise), "Bessel"))
            found.append(min(options, key=lambda choice: choice.error))
        return found


def _inverse_root(matrix: np.ndarray) -> np.ndarray:
    """R with R R^T the inverse of symmetric positive matrices (..., n, n), to what rounding allows."""
    scale = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / scale[..., None, :] / scale[..., :, None])
    return np.asarray(vectors / np.sqrt(np.maximum(values, SIGNIFICANT))[..., None, :] / scale[..., :, None])


def _rounded(value: float) -> float:
    """To four digits, for people."""
    return float(f"{value:.4g}")
