"""Estimation errors of an observer on trajectories that its training never saw."""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from kkl_gym.simulate import check_duration, simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.checks import noise_level, noise_levels
from training.evaluation.levels import Level
from training.evaluation.metrics import nrmse, smape
from training.kalman import ExtendedKalmanFilter, measurement_covariance, process_intensity
from training.maps.coordinates import root
from training.seeds import Stream, generator
from training.sources.simulated import LEAST_PROCESS_NOISE, unknown_start
from training.trajectories.motions import Controller, draw_process_noise, random_inputs, under_policy

TRANSIENT = 0.2  # length of the transient at the start of a trajectory, as a share of the trajectory
MAX_TRIES = 1000  # number of successive starts inside X after which the search for one outside X ends

Domain = Literal["X", "1.5X", "2X"]


class NoStartsError(ValueError):
    """Raised if a domain holds no starts, or if the trajectories from all starts leave the bounds."""


@dataclass(frozen=True)
class Errors:
    """Errors of n trajectories: SMAPE of all samples and after the transient (n,), NRMSE after it (n, nx)."""

    full: np.ndarray
    late: np.ndarray
    nrmse: np.ndarray


@dataclass(frozen=True)
class UnseenTrajectories:
    """Test trajectories ``x`` (steps + 1, n, nx) within the bounds; ``inside`` marks them among all drawn ones."""

    x: np.ndarray
    u: np.ndarray
    inside: np.ndarray
    dt: float
    process_noise: float = 0.0
    plant: System | None = None

    @property
    def escaped(self) -> int:
        """Number of trajectories that left the bounds."""
        return int((~self.inside).sum())


def starts(system: System, domain: Domain, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return starts (n, nx) that the system draws in X, or in a multiple of X but outside X, as in the paper."""
    if domain == "X":
        return system.draw_starts(rng, n)
    low, high = system.box()
    factor, beyond = float(domain.removesuffix("X")), list[np.ndarray]()
    while len(beyond) < n:
        for _ in range(MAX_TRIES):
            (x,) = system.draw_starts(rng, 1, factor)
            if ((x < low) | (x > high)).any():
                beyond.append(x)
                break
        else:
            raise NoStartsError(
                f"no state of {system.name} in {domain} lies beyond X = {system.X}: bounds = {system.bounds} leave no "
                "room there, or draw_starts ignores its factor"
            )
    return np.array(beyond)


def unseen_trajectories(
    system: System,
    dt: float,
    *,
    n: int,
    duration: float,
    seed: int,
    domain: Domain = "X",
    driven: bool = False,
    stream: Stream = Stream.EVALUATION,
    process_noise: float = 0.0,
    policy: Controller | None = None,
    plant: System | None = None,
) -> UnseenTrajectories:
    """Simulate test trajectories from random numbers that no training draws.

    Parameters
    ----------
    system : System
        The model of the observers. It determines the starts, the scale of the noise and the inputs.
    dt : float
        Sampling interval in seconds.
    n : int
        Number of trajectories.
    duration : float
        Length of each trajectory in seconds.
    seed : int
        Seed of the starts, the inputs and the process noise.
    domain : {"X", "1.5X", "2X"}
        Where the trajectories start: in X, or in the multiple of X but outside X.
    driven : bool
        Whether inputs are random steps and sines, not 0. With ``policy``: whether it explores and sees inexact states.
    stream : Stream
        Stream of random numbers, for evaluation or for validation.
    process_noise : float
        Level of the process noise, in multiples of ``System.scale`` per second.
    policy : callable, optional
        Function from states (n, nx) to actions (n, nu) in [-1, 1], which drive the trajectories.
    plant : System, optional
        The system to simulate, such as ``system`` with other parameters (:meth:`kkl_gym.System.replace`); by default
        ``system``.

    Returns
    -------
    UnseenTrajectories
        The trajectories that stayed within the bounds of the plant: ``x`` (steps + 1, n, nx), ``u`` (steps, n, nu), and
        the mask ``inside`` that marks them among all drawn trajectories.

    Raises
    ------
    ValueError
        If ``domain``, ``n``, ``duration``, ``seed`` or ``process_noise`` is invalid, ``domain`` holds no starts, or the
        plant's numbers of states, inputs or outputs differ from the system's.
    """
    moving = plant or system
    sizes, expected = ((each.nx, each.nu, each.ny) for each in (moving, system))
    if sizes != expected:
        raise ValueError(f"a plant with (nx, nu, ny) = {sizes} does not fit {system.name}, which has {expected}")
    if n < 1 or seed < 0:
        raise ValueError(f"n must be positive and seed not negative, got n = {n} and seed = {seed}")
    check_duration(duration, dt)
    if domain not in get_args(Domain):
        raise ValueError(f"domain must be one of {', '.join(get_args(Domain))}, got {domain!r}")
    process_noise = noise_level("process_noise", process_noise)
    rng = generator(stream, seed)
    x0 = starts(system, domain, n, rng)
    steps = round(duration / dt)
    u = np.zeros((steps, n, system.nu))
    if driven and not policy:
        u = random_inputs(system, n, steps, dt=dt, rng=rng, kinds=("steps", "sine"))
    w = draw_process_noise(system, process_noise, n=n, steps=steps, rng=generator(stream, seed, 2))
    if policy:
        exploring, own = generator(stream, seed, 3), np.full(n, not driven)
        x, u = under_policy(system, policy, x0, steps=steps, dt=dt, rng=exploring, own=own, w=w, plant=plant)
    else:
        x = simulate(moving, x0, steps, dt, u=u, w=w)
    inside = np.isfinite(x[-1]).all(-1)
    return UnseenTrajectories(x[:, inside], u[:, inside], inside, dt, process_noise, plant)


def errors(
    artifact: Artifact | None,
    system: System,
    trajectories: UnseenTrajectories,
    *,
    measurement_noise: Level,
    seed: int,
    skip: float | None = None,
) -> Errors:
    """Return an observer's errors on test trajectories. The observer knows the noise levels, and assumes ``system``.

    Parameters
    ----------
    artifact : Artifact or None
        The observer; None for an extended Kalman filter that knows the system's equations, the inputs, both levels of
        noise, and the mean and covariance of the starts in X.
    system : System
        The model of the observer.
    trajectories : UnseenTrajectories
        Test trajectories.
    measurement_noise : float or sequence of float, length ny
        Standard deviation of the noise on each sample of y, one for all outputs or one for each.
    seed : int
        Seed of the measurement noise.
    skip : float, optional
        Length of the transient in seconds; by default a fifth of the trajectories' length.

    Returns
    -------
    Errors
        For each trajectory ``full`` (n,), the SMAPE over all samples; ``late`` (n,), the SMAPE after the transient; and
        ``nrmse`` (n, nx) after the transient; all in percent.

    Raises
    ------
    ValueError
        If the level of noise is invalid, or beyond the map's range.
    """
    x_hat, _ = estimates(artifact, system, trajectories, measurement_noise=measurement_noise, seed=seed)
    return _errors(trajectories, x_hat, skip)


def noise_limit(
    system: System, trajectories: UnseenTrajectories, *, measurement_noise: Level, seed: int, skip: float | None = None
) -> Errors:
    """Return errors at the posterior Cramér-Rao bound, which no unbiased causal estimator can beat.

    The errors are drawn from N(0, P), where P is the bound along each trajectory. The bound follows from the plant's
    exact equations, its inputs, both noise levels, and the covariance of the starts in X. A biased estimator, such as
    one that knows that starts are uniform in a box, may have smaller errors in the first samples.

    Parameters
    ----------
    system, trajectories, measurement_noise, skip
        As for :func:`errors`. Trajectories must start in X. The bound assumes at least 0.2 % of the default noise on y.
    seed : int
        Seed of the drawn errors.

    Returns
    -------
    Errors
        For each trajectory, as :func:`errors` returns them.

    Raises
    ------
    ValueError
        If the level of noise is invalid.
    """
    level, dt = noise_levels("measurement_noise", measurement_noise, system.ny), trajectories.dt
    x, plant = trajectories.x, trajectories.plant or system
    Q, R = process_intensity(system, trajectories.process_noise, dt), measurement_covariance(system, level)
    bound = ExtendedKalmanFilter(plant, dt, Q=Q, R=R, start=unknown_start(system))
    _, P = bound.along(plant.output(x), trajectories.u, x)
    drawn = generator(Stream.EVALUATION, seed, 1).standard_normal((*x.shape, 1))
    return _errors(trajectories, x + (root(P) @ drawn)[..., 0], skip)


def _errors(trajectories: UnseenTrajectories, x_hat: np.ndarray, skip: float | None) -> Errors:
    x = trajectories.x
    first = round(TRANSIENT * len(x)) if skip is None else round(skip / trajectories.dt)
    return Errors(smape(x, x_hat), smape(x, x_hat, first), nrmse(x, x_hat, first))


def estimates(
    artifact: Artifact | None,
    system: System,
    trajectories: UnseenTrajectories,
    *,
    measurement_noise: Level,
    seed: int,
    covariances: bool = False,
) -> tuple[np.ndarray, Any]:
    """Return estimates (steps + 1, n, nx) along test trajectories, and covariances or None; see :func:`errors`."""
    level, dt, u = noise_levels("measurement_noise", measurement_noise, system.ny), trajectories.dt, trajectories.u
    y, process_noise = measured(system, trajectories, level, seed), trajectories.process_noise
    if artifact is None:
        Q = process_intensity(system, max(process_noise, LEAST_PROCESS_NOISE / system.pace), dt)
        return ExtendedKalmanFilter(system, dt, Q=Q, R=measurement_covariance(system, level)).along(y, u)
    observer, inputs = KKLObserver(artifact, level, process_noise=process_noise), u if artifact.nu else None
    return observer.estimate(y, inputs), observer.estimate_covariance(y, inputs) if covariances else None


def measured(system: System, trajectories: UnseenTrajectories, measurement_noise: Level, seed: int) -> np.ndarray:
    """Return the noisy outputs (steps + 1, n, ny) of trajectories."""
    y = (trajectories.plant or system).output(trajectories.x)
    return y + np.asarray(measurement_noise) * generator(Stream.EVALUATION, seed, 1).standard_normal(y.shape)


def parameter_errors(
    artifact: Artifact, system: System, trajectories: UnseenTrajectories, *, measurement_noise: Level, seed: int
) -> np.ndarray:
    """Return parameters' rms errors in % after the transient; without a plant, the last states in x are the truth."""
    names, (_, n, nx) = artifact.estimated_parameters, trajectories.x.shape
    if not n:
        raise ValueError(f"all {trajectories.escaped} runs left bounds = {system.bounds}")
    level = noise_levels("measurement_noise", measurement_noise, system.ny)
    observer, u = KKLObserver(artifact, level, process_noise=trajectories.process_noise), trajectories.u
    values = observer.estimate_parameters(measured(system, trajectories, level, seed), u if artifact.nu else None)
    plant = trajectories.plant
    true = [plant.parameters[name] for name in names] if plant else trajectories.x[0, :, nx - len(names) :]
    return np.asarray(100.0 * np.sqrt(np.mean((values[round(TRANSIENT * len(values)) :] / true - 1.0) ** 2, (0, 1))))
