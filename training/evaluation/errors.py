"""Estimation errors of an observer on trajectories that its training never saw."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from kkl_gym.simulate import check_duration, simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.checks import noise_levels
from training.evaluation.levels import Level
from training.evaluation.metrics import nrmse, smape
from training.kalman import ExtendedKalmanFilter, measurement_covariance, process_intensity
from training.seeds import Stream, generator
from training.trajectories.motions import Controller, draw_process_noise, random_inputs, under_policy

TRANSIENT = 0.2  # part of a trajectory that is left out of the errors "after the transient"

TRIES = 1000  # starts of which one at least should lie beyond X

Domain = Literal["X", "1.5X", "2X"]


class NoStartsError(ValueError):
    """A multiple of X holds no starts beyond X."""


@dataclass(frozen=True)
class Errors:
    """Errors of each trajectory that stayed within bounds, (n,) and (n, nx), and how many did not."""

    full: np.ndarray
    late: np.ndarray
    nrmse: np.ndarray
    escaped: int


@dataclass(frozen=True)
class UnseenTrajectories:
    """Test trajectories, ``x`` (steps + 1, n, nx), measured without noise, and which of those drawn are inside."""

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
    """Starts (n, nx), uniform in X, or in a multiple of X (as in the paper) without X itself."""
    if domain == "X":
        return system.draw_starts(rng, n)
    low, high = system.box()
    factor, found = float(domain.removesuffix("X")), list[np.ndarray]()
    tries = 0
    while len(found) < n:
        (x,) = system.draw_starts(rng, 1, factor)
        if ((x < low) | (x > high)).any():
            found.append(x)
        tries += 1
        if tries > TRIES * (1 + len(found)):
            raise NoStartsError(
                f"no state of {system.name} in {domain} lies beyond X = {system.X}: bounds = {system.bounds} leave no "
                "room there, or its draw_starts takes no notice of the factor"
            )
    return np.array(found)


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
    """Simulate test trajectories, whose random numbers training never draws.

    Parameters
    ----------
    system : System
        What observers are made for: it moves, unless a plant does, and says where starts are, and what noise, inputs
        and pace are usual.
    dt : float
        Sampling interval in seconds.
    n : int
        Number of trajectories.
    duration : float
        Length of each in seconds.
    seed : int
        Seed of the starts, the inputs and the process noise.
    domain : {"X", "1.5X", "2X"}
        Where they start, see :func:`starts`.
    driven : bool
        Whether inputs act: random bounded steps and sines in turn. Under a policy, whether it errs and explores.
    stream : Stream
        Random numbers to draw: those of evaluation or those of validation.
    process_noise : float
        Level of the process noise, in multiples of the system's scale per second.
    policy : callable, optional
        Acts on the system, see :func:`training.trajectories.motions.under_policy`; by default nothing does.
    plant : System, optional
        What moves in the place of the system, such as the same with other parameters
        (:meth:`kkl_gym.System.replace`, :func:`training.evaluation.plants.off_by`).

    Returns
    -------
    UnseenTrajectories
        Those that stayed within the declared bounds of what moves, and which these are.

    Raises
    ------
    ValueError
        On an unknown domain, or unless n, duration, seed and level make sense, or if the plant has other numbers of
        states, inputs or outputs than the system.
    """
    moving = plant or system
    sizes, expected = ((each.nx, each.nu, each.ny) for each in (moving, system))
    if sizes != expected:
        raise ValueError(f"a plant of {sizes} states, inputs and outputs does not fit {system.name}, of {expected}")
    if n < 1 or seed < 0:
        raise ValueError(f"cannot simulate {n} trajectories from seed {seed}")
    check_duration(duration, dt)
    if domain not in get_args(Domain):
        raise ValueError(f"domain must be one of {', '.join(get_args(Domain))}, got {domain!r}")
    if not 0 <= process_noise < np.inf:
        raise ValueError(f"process_noise must be finite and not negative, got {process_noise!r}")
    rng = generator(stream, seed)
    x0 = starts(system, domain, n, rng)
    steps = round(duration / dt)
    u = np.zeros((steps, n, system.nu))
    if driven and not policy:
        u = random_inputs(system, n, steps, dt=dt, rng=rng, kinds=("steps", "sine"))
    w = None
    if process_noise:
        w = draw_process_noise(system, process_noise, n=n, steps=steps, rng=generator(stream, seed, 2))
    if policy:
        exploring, own = generator(stream, seed, 3), np.full(n, not driven)
        x, u = under_policy(system, policy, x0, steps=steps, dt=dt, rng=exploring, own=own, w=w, plant=plant)
    else:
        x = simulate(moving, x0, steps, dt, u=u if driven else None, w=w)
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
    """Errors of an observer on test trajectories. It is given the levels of noise, and nothing of another plant.

    Parameters
    ----------
    artifact : Artifact or None
        The observer; None for an extended Kalman filter that knows the system's equations, the inputs, both levels of
        noise, and that starts are uniform in X.
    system : System
        What it was made for.
    trajectories : UnseenTrajectories
        What it is to follow.
    measurement_noise : float or sequence of float, length ny
        Standard deviation of the noise on each sample of y, of all outputs or each.
    seed : int
        Seed of the measurement noise.
    skip : float, optional
        Seconds left out of ``late``; by default a fifth of the trajectories' length.

    Returns
    -------
    Errors
        One for each trajectory.

    Raises
    ------
    ValueError
        If the level of noise is invalid, or beyond the map's range.
    """
    x_hat = estimates(artifact, system, trajectories, measurement_noise=measurement_noise, seed=seed)
    x = trajectories.x
    first = round(TRANSIENT * len(x)) if skip is None else round(skip / trajectories.dt)
    return Errors(smape(x, x_hat), smape(x, x_hat, first), nrmse(x, x_hat, first), trajectories.escaped)


def estimates(
    artifact: Artifact | None, system: System, trajectories: UnseenTrajectories, *, measurement_noise: Level, seed: int
) -> np.ndarray:
    """Estimates along test trajectories, (steps + 1, n, nx), whose errors :func:`errors` measures."""
    observer = observer_of(artifact, system, trajectories, measurement_noise)
    return follow(observer, measured(system, trajectories, measurement_noise, seed), trajectories.u)[0]


def observer_of(
    artifact: Artifact | None, system: System, trajectories: UnseenTrajectories, measurement_noise: Level
) -> KKLObserver | ExtendedKalmanFilter:
    """An observer that is given both levels of noise; without an artifact a Kalman filter, as in :func:`errors`."""
    level = noise_levels("measurement_noise", measurement_noise, system.ny)
    if artifact is not None:
        return KKLObserver(artifact, level, process_noise=trajectories.process_noise)
    Q = process_intensity(system, trajectories.process_noise, trajectories.dt)
    return ExtendedKalmanFilter(system, trajectories.dt, Q=Q, R=measurement_covariance(system, level))


def follow(
    observer: KKLObserver | ExtendedKalmanFilter, y: np.ndarray, u: np.ndarray, *, covariances: bool = False
) -> tuple[np.ndarray, np.ndarray | None]:
    """Estimates along records (steps + 1, n, nx), and their covariances if these are asked for."""
    if isinstance(observer, KKLObserver):
        inputs = u if observer.artifact.nu else None
        return observer.estimate(y, inputs), observer.estimate_covariance(y, inputs) if covariances else None
    state, found = observer.start(y.shape[1]), []
    for k in range(len(y)):
        state = observer.advance(state, y[k], u[k - 1])  # which ignores the input before the first sample
        found.append((state.x, state.P) if covariances else (state.x,))
    x_hat, *beside = map(np.array, zip(*found, strict=True))
    return x_hat, beside[0] if covariances else None


def measured(system: System, trajectories: UnseenTrajectories, measurement_noise: Level, seed: int) -> np.ndarray:
    """Outputs of trajectories with noise, (steps + 1, n, ny)."""
    level = noise_levels("measurement_noise", measurement_noise, system.ny)
    y = (trajectories.plant or system).output(trajectories.x)
    return y + np.asarray(level) * generator(Stream.EVALUATION, seed, 1).standard_normal(y.shape)
