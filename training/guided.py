"""A Kalman filter that a learned KKL observer starts, watches over and starts again."""

import dataclasses
import os
from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from kkl_gym.systems import get_system
from observers import Artifact, KKLObserver
from observers.checks import bool_array, check_dt, noise_level, noise_levels, real_array, shown
from observers.names import resolve
from training.kalman import LEAST_VARIANCE, IteratedKalmanFilter, measurement_covariance, process_intensity
from training.seeds import Stream, generator
from training.trajectories.noise import draw_process_noise, noisy_output
from training.trajectories.signals import random_inputs

# The least noise that is assumed, in the units of training.kalman: a filter that is taken back where it is lost may
# trust its samples and its model more.
NOISE_FLOOR, LEAST_PROCESS_NOISE = 0.001, 0.0005
RUNS = 200  # that say how far the observer's estimates are off
FACTOR = 2.0  # of X, from which they start: states beyond X are to be found too
SETTLED = 5.0  # s at the pace of the shipped systems, after which errors count as those of any later age
AGES = 30  # at which they are looked at
WINDOW = 0.5  # s at that pace, over which innovations are averaged
ROUNDING = 1e-9  # of its largest entry, by which Q may miss being symmetric and positive
CHANCE = 1e-9  # that their mean square is as large as its limit where model and levels of noise hold


class GuidedKalmanFilter:
    """An unscented Kalman filter beside a KKL observer, which says where to begin.

    The Kalman filter takes each step twice, see :class:`training.kalman.IteratedKalmanFilter`. It has the system's
    equations and is as good as they are, once it is near the state. The observer finds the state from anywhere and
    cannot lose it. Both run all the time, each row of a batch by itself, and what is returned is the Kalman filter's
    estimate. It is replaced by the observer's, in the rows concerned,

    - where the observer is surer: its covariance has the smaller determinant. That is so early on, if at all.
    - where the innovations say that the filter is lost: their mean square over the last half second, at the pace of the
      shipped systems, is beyond chance, about twice what the filter expects, or it has left the system's declared
      bounds. Then the observer may be misled too, by what came before. Its covariance is taken to be that of one no
      older than the window.

    The covariance of the observer's errors is that of simulated runs, from starts in 2X, at each age and at the levels
    of noise told.

    Parameters
    ----------
    system : System, type of System or str
        The equations, as :func:`kkl_gym.get_system` takes them.
    artifact : Artifact, str or PathLike, optional
        A map for the system: what was trained, a file, or a shipped name; by default what ships for the system.
    dt : float, optional
        Sampling interval in seconds; by default the map's, and no other will do.
    measurement_noise : float or sequence of float, length ny, optional
        Standard deviation of the noise on each sample, of all outputs or each; by default what is usual for the map. A
        map that knows no such level is told the largest that it knows.
    process_noise : float, optional
        Level of the noise on the state's derivative, in multiples of the system's scale per second; by default the
        system's own, as in the environments. 0 is an exact model, of which the Kalman filter allows a little error.
    Q : array_like, shape (nx, nx), optional
        Intensity of the process noise that the Kalman filter assumes, per second; by default that of the level. Larger
        where the equations are not the plant's.

    Attributes
    ----------
    restarts : ndarray of int, shape (...,)
        How often innovations have sent each row back to the observer since its reset.

    Raises
    ------
    ValueError
        If an argument makes no sense, or nothing ships for the system; :class:`observers.ArtifactError` (a ValueError)
        if the map was made for another system.
    """

    def __init__(
        self,
        system: System | type[System] | str,
        *,
        artifact: Artifact | str | os.PathLike[str] | None = None,
        dt: float | None = None,
        measurement_noise: float | Sequence[float] | None = None,
        process_noise: float | None = None,
        Q: np.ndarray | None = None,
    ) -> None:
        system = get_system(system)
        if not isinstance(artifact, Artifact):
            artifact = Artifact.read(resolve(system.name if artifact is None else artifact))
        dt = artifact.filter.dt if dt is None else check_dt(dt)
        artifact.check(system.name, system.parameters, dt=dt, ny=system.ny, nu=system.nu)
        level = artifact.measurement_noise if measurement_noise is None else measurement_noise
        level = noise_levels("measurement_noise", level, system.ny)
        disturbed = system.process_noise if process_noise is None else noise_level("process_noise", process_noise)
        Q = process_intensity(system, disturbed, dt, least=LEAST_PROCESS_NOISE) if Q is None else _checked(Q, system.nx)
        self.system = system
        self._batch: tuple[int, ...] | None = None
        artifact = dataclasses.replace(artifact, flow=None)  # which would be a second filter of the kind
        self._observer = KKLObserver(artifact, artifact.inverse.within(level), process_noise=disturbed)
        self._filter = IteratedKalmanFilter(system, dt, Q=Q, R=measurement_covariance(system, level, floor=NOISE_FLOOR))
        self._ages, self._covariances = _errors_by_age(self._observer, system, level)
        self._log_volumes = np.linalg.slogdet(self._covariances)[1]
        self._window, self._share = round(WINDOW * system.pace / dt), -np.expm1(-dt / (WINDOW * system.pace))
        freedom = system.ny * (2 - self._share) / self._share  # of the weighted mean, as its variance has it
        self._limit = chdtri(freedom, CHANCE) / freedom

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the estimate, (..., nx, nx), as the Kalman filter has it; raises RuntimeError before reset."""
        shape = (*self._shape(), self.system.nx, self.system.nx)
        return self._filter.P.reshape(shape).copy()

    def reset(self, y0: np.ndarray) -> np.ndarray:
        """Forget the past and take in the first sample.

        Parameters
        ----------
        y0 : array_like, shape (..., ny)
            The sample; its shape is that of the batch from here on.

        Returns
        -------
        ndarray, shape (..., nx)
            The first estimate.

        Raises
        ------
        ValueError
            If a shape is wrong or there is anything but finite real numbers; the filter is then as it was.
        """
        y0 = real_array("y", y0)
        self._observer.reset(y0)
        self._batch, flat = y0.shape[:-1], y0.reshape(-1, self.system.ny)
        self._filter.reset(flat)
        self._age, self._mean_square = np.zeros(len(flat), dtype=int), np.ones(len(flat))
        self.restarts = np.zeros(self._batch, dtype=int)
        return self._supervised()

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> None:
        """Forget the past in some rows of the batch and take in their first samples.

        Parameters
        ----------
        y0 : array_like, shape (number of True in rows, ny)
            First samples.
        rows : array_like of bool, shape (...,)
            The rows of the batch.

        Raises
        ------
        ValueError
            As :meth:`reset`.
        RuntimeError
            Before :meth:`reset`.
        """
        y0, rows = real_array("y", y0), bool_array("rows", rows, self._shape())
        self._observer.restart(y0, rows)
        flat = rows.ravel()
        self._filter.restart(y0, flat)
        self._age[flat], self._mean_square[flat], self.restarts[rows] = 0, 1.0, 0
        self._supervised()

    def step(self, y: np.ndarray | None, u: np.ndarray | None = None) -> np.ndarray:
        """Take in the next sample.

        Parameters
        ----------
        y : array_like, shape (..., ny), or None
            The sample; None, or NaN in rows and of outputs, where it is missing.
        u : array_like, shape (..., nu), optional
            The input held since the sample before; by default zero.

        Returns
        -------
        ndarray, shape (..., nx)
            The estimate.

        Raises
        ------
        ValueError
            If a shape is wrong, there is anything but finite real numbers (and NaN as described), or an input that the
            map does not know of is not zero; the filter is then as it was.
        RuntimeError
            Before :meth:`reset`.
        """
        batch, ny, nu = self._shape(), self.system.ny, self.system.nu
        y = np.full((*batch, ny), np.nan) if y is None else real_array("y", y)
        u = np.zeros((*batch, nu)) if u is None else real_array("u", u)
        for name, values, width in (("y", y, ny), ("u", u, nu)):
            if values.shape != (*batch, width):
                raise ValueError(f"{name} must have shape {(*batch, width)}, got {values.shape}")
        missing = np.isnan(y).all(-1)
        if missing.any():
            self._observer.advance(np.where(missing[..., None], 0.0, y), u, rows=~missing)
            self._observer.advance(None, u, rows=missing)
        else:
            self._observer.advance(y, u)
        self._filter.advance(y.reshape(-1, ny), u.reshape(self._age.size, nu))
        nis, seen = self._filter.nis, (~np.isnan(y)).mean(-1).ravel()  # in part it scatters more, and counts less
        self._age += seen > 0.0
        step = np.where(np.isinf(nis), 0.0, nis) - self._mean_square
        self._mean_square = np.where(np.isinf(nis), np.inf, self._mean_square + self._share * seen * step)
        return self._supervised()

    def _supervised(self) -> np.ndarray:
        """Take what is lost, or less sure than the observer, from there; returns the estimates."""
        filters, batch = self._filter, self._shape()
        lost = ~(self._mean_square <= self._limit)
        self.restarts += lost.reshape(batch)
        self._age[lost], self._mean_square[lost] = np.minimum(self._age[lost], self._window), 1.0
        of_age = np.searchsorted(self._ages, self._age, side="right") - 1
        taken = lost | (self._log_volumes[of_age] < np.linalg.slogdet(filters.P)[1])
        if taken.any():
            filters.x, filters.P = filters.x.copy(), filters.P.copy()
            filters.x[taken] = self._observer.decode(taken.reshape(batch))
            filters.P[taken] = self._covariances[of_age[taken]]
        return filters.decode().reshape(*batch, self.system.nx)

    def _shape(self) -> tuple[int, ...]:
        """That of the batch; RuntimeError before reset."""
        if self._batch is None:
            raise RuntimeError("call reset(y0) before the filter is used")
        return self._batch


def _checked(Q: np.ndarray, nx: int) -> np.ndarray:
    """The intensity of the process noise; ValueError if it is none."""
    Q = real_array("Q", Q)
    sound = Q.shape == (nx, nx) and np.isfinite(Q).all()
    rounding = ROUNDING * np.abs(Q).max(initial=0.0)
    if not sound or np.abs(Q - Q.T).max() > rounding or np.linalg.eigvalsh(Q)[0] < -rounding:
        raise ValueError(f"Q must be a symmetric, positive semidefinite matrix of shape {(nx, nx)}, got {shown(Q)}")
    return (Q + Q.T) / 2


def _errors_by_age(
    observer: KKLObserver, system: System, level: float | tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Ages in samples, (m,), from 0 on, and the mean outer products of the observer's errors then, (m, nx, nx).

    They are those of simulated runs, every other one under random inputs if the map knows inputs.
    """
    dt, rng = observer.artifact.filter.dt, generator(Stream.CALIBRATION, 0, 1)
    last = round(SETTLED * system.pace / dt)
    ages = np.unique(np.round(np.geomspace(1, last + 1, AGES)).astype(int)) - 1
    u, w = np.zeros((last, RUNS, system.nu)), None
    if observer.artifact.nu:
        u[:, ::2] = random_inputs(system, len(range(0, RUNS, 2)), last, dt=dt, rng=rng)
    if observer.process_noise:
        w = draw_process_noise(system, observer.process_noise, n=RUNS, steps=last, rng=rng)
    x = simulate(system, system.draw_starts(rng, RUNS, FACTOR), last, dt, u=u, w=w)
    inside = np.isfinite(x[-1]).all(-1)
    if not inside.any():
        raise ValueError(f"every run from 2X left the bounds of {system.name}, {system.bounds}: widen them or shrink X")
    x, u = x[:, inside], u[:, inside]
    y = noisy_output(system, x, measurement_noise=level, rng=rng)
    errors = [observer.reset(y[0]) - x[0]]
    for k in range(1, last + 1):
        observer.advance(y[k], u[k - 1] if observer.artifact.nu else None)
        if k in ages:
            errors.append(observer.decode() - x[k])
    low, high = system.box()
    least = np.diag(LEAST_VARIANCE * (high - low) ** 2)
    return ages, np.array([e.T @ e / len(e) + least for e in errors])
