"""The least error of any observer of a system: empirical observability Gramians along its motions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from training.diagnosis.subject import Subject
from training.evaluation.levels import Level
from training.neighbours import RESOLUTION
from training.sources.simulated import unknown_start

MOTIONS = 20  # that are followed
CHUNK = 250  # samples whose derivatives are taken at once
AGES = 60  # at which errors are evaluated
FARTHEST = 1e5  # growth of an error in the start, beyond which squares of it exceed double precision
SHORTEST = 10  # samples that must be followed
SIGNIFICANT = 1e-13  # rounding error of a matrix of unit diagonal


@dataclass(frozen=True)
class Limits:
    """What y tells of the start of motions, to first order, and what is left of the state.

    An error d in the start moves the state by Phi d and y by C Phi d. From samples of y with noise of covariance R and
    a start of covariance S, the start is known to (W + S^-1)^-1 with the Gramian W, the sum of (C Phi)^T R^-1 C Phi,
    and the state to that carried along by Phi. An extended Kalman filter that knows the equations leaves as much.

    States are in half-widths of X. Shapes: ``x`` (steps, n, nx), ``Phi`` (steps, n, nx, nx), ``seen`` = C Phi
    (steps, n, ny, nx).
    """

    subject: Subject
    x: np.ndarray
    Phi: np.ndarray
    seen: np.ndarray

    @classmethod
    def of(cls, subject: Subject) -> "Limits":
        """Follow motions from X that stay within the bounds; ValueError if they are too few or too short."""
        x, u = (values[:, :MOTIONS] for values in subject.followed)
        if 2 * x.shape[1] < MOTIONS:
            raise ValueError(
                f"only {x.shape[1]} motions from X stayed within the bounds; widen the bounds, shrink X or shorten the "
                "motions, or give a policy that holds the system (--policy)"
            )
        Phi = np.empty((*x.shape, subject.system.nx))
        Phi[0] = np.eye(subject.system.nx)
        end = len(x)
        for k in range(0, len(u), CHUNK):
            for i, step in enumerate(subject.step_derivatives(x[:-1][k : k + CHUNK], u[k : k + CHUNK]), k + 1):
                Phi[i] = step @ Phi[i - 1]
            # Where motions part, later times depend on the start beyond what double precision can tell.
            size = np.abs(Phi[k : k + CHUNK + 1]).max((1, 2, 3))
            if not (size < FARTHEST).all():
                end = k + int((~(size < FARTHEST)).argmax())
                break
        if end < SHORTEST:
            raise ValueError(
                f"only {end - 1} samples of {subject.dt:g} s can be followed, of a duration of {subject.duration:g} s: "
                "take a longer one, or a smaller dt"
            )
        x, Phi = x[:end], Phi[:end]
        return cls(subject, x, Phi, subject.output_derivatives(x) @ Phi)

    @property
    def resolution(self) -> tuple[float, ...]:
        """The noise that stands for y without any: what a network resolves."""
        return tuple(RESOLUTION * size for size in self.subject.system.output_range)

    @cached_property
    def ages(self) -> np.ndarray:
        """Samples since the start at which errors are evaluated, with equal shares early and late."""
        last = len(self.x) - 1
        return np.unique(
            np.concatenate([np.geomspace(1, last, AGES // 2), np.linspace(0, last, AGES // 2)]).astype(int)
        )

    @cached_property
    def weights(self) -> np.ndarray:
        """The share of each age in a motion, (ages,). What comes after the last is like the second half of the rest."""
        weights = np.gradient(self.ages.astype(float))
        late = np.where(self.ages > self.ages[-1] / 2, weights, 0.0)
        weights += late / late.sum() * max(0.0, self.subject.duration / self.subject.dt - self.ages[-1])
        return np.asarray(weights / weights.sum())

    def errors(self, measurement_noise: Level) -> np.ndarray:
        """Root mean square errors of the states by age, (ages, nx), in their standard deviations along motions."""
        left = self.Phi[self.ages] @ _inverse_root(self._information(measurement_noise)[self.ages] + self._known)
        spread = self.x.std((0, 1)) / self.subject.half
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.sqrt((left**2).sum(-1).mean(1)) / spread)

    def unknown_of_starts(self, measurement_noise: Level) -> np.ndarray:
        """What all of y leaves unknown of where a motion started: a covariance (nx, nx), in units of that of X."""
        known = np.linalg.cholesky(self._known).T
        root = known @ _inverse_root(self._information(measurement_noise)[-1] + self._known)
        return np.asarray((root @ root.mT).mean(0))

    @cached_property
    def _known(self) -> np.ndarray:
        """What is known of the start without y: the inverse of S, (nx, nx)."""
        half = self.subject.half
        return np.linalg.inv(unknown_start(self.subject.system)[1] / np.multiply.outer(half, half))

    def _information(self, measurement_noise: Level) -> np.ndarray:
        """The Gramians by sample, (steps, n, nx, nx)."""
        levels = np.broadcast_to(np.asarray(measurement_noise, dtype=float), (self.subject.system.ny,))
        seen = self.seen / np.maximum(levels, self.resolution)[:, None]
        return np.asarray(np.cumsum(seen.mT @ seen, axis=0))


def _inverse_root(matrix: np.ndarray) -> np.ndarray:
    """R with R R^T the inverse of symmetric positive matrices (..., n, n), to what rounding allows."""
    scale = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / scale[..., None, :] / scale[..., :, None])
    return np.asarray(vectors / np.sqrt(np.maximum(values, SIGNIFICANT))[..., None, :] / scale[..., :, None])
