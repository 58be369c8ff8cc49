"""Estimation errors of an observer on trajectories that its training never saw."""

from dataclasses import dataclass, replace
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
from training.trajectories.motions import draw_process_noise, noisy_output, random_inputs, under_policy
from training.trajectories.policies import Controller

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
    process_noise: float = 0.0
    plant: System | None = None

    @property
    def escaped(self) -> int:
        """Number of trajectories that left the bounds."""
        return int((~self.inside).sum())

    def first(self, n: int) -> "UnseenTrajectories":
        """Take the first of those drawn.

        Drawn alone they might differ: rounding depends on the batch, and chaos on rounding.
        """
        inside = self.inside[:n]
        return replace(self, x=self.x[:, : inside.sum()], u=self.u[:, : inside.sum()], inside=inside)


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
    return UnseenTrajectories(x[:, inside], u[:, inside], inside, process_noise, plant)


def errors(
    artifact: Artifact,
    system: System,
    trajectories: UnseenTrajectories,
    *,
    measurement_noise: Level,
    seed: int,
    skip: float | None = None,
) -> Errors:
    """Errors of an observer on test trajectories. It is told the levels of noise, and nothing of another plant.

    Parameters
    ----------
    artifact : Artifact
        The observer.
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
        If the level of noise is none, or beyond the map's range.
    """
    x_hat = estimates(artifact, system, trajectories, measurement_noise=measurement_noise, seed=seed)
    return _errors(trajectories, x_hat, artifact.filter.dt, skip)


def estimates(
    artifact: Artifact, system: System, trajectories: UnseenTrajectories, *, measurement_noise: Level, seed: int
) -> np.ndarray:
    """What an observer makes of test trajectories, (steps + 1, n, nx): its errors are what :func:`errors` measures."""
    level = noise_levels("measurement_noise", measurement_noise, system.ny)
    observer = KKLObserver(artifact, level, process_noise=trajectories.process_noise)
    y = measured(system, trajectories, level, seed)
    return observer.estimate(y, trajectories.u if artifact.nu else None)


def kalman_errors(
    system: System,
    trajectories: UnseenTrajectories,
    dt: float,
    *,
    measurement_noise: Level,
    seed: int,
    skip: float | None = None,
) -> Errors:
    """Errors of an extended Kalman filter on the trajectories and the noise that :func:`errors` takes.

    It knows the system's equations, the inputs and both levels of noise, and that starts are uniform in X.
    """
    x_hat = kalman_estimates(system, trajectories, dt, measurement_noise=measurement_noise, seed=seed)
    return _errors(trajectories, x_hat, dt, skip)


def kalman_estimates(
    system: System, trajectories: UnseenTrajectories, dt: float, *, measurement_noise: Level, seed: int
) -> np.ndarray:
    """What the filter of :func:`kalman_errors` makes of test trajectories, (steps + 1, n, nx)."""
    level = noise_levels("measurement_noise", measurement_noise, system.ny)
    y = measured(system, trajectories, level, seed)
    kalman = kalman_filter(system, dt, trajectories.process_noise, level)
    x_hat = np.empty_like(trajectories.x)
    x_hat[0] = kalman.reset(y[0])
    for k in range(1, len(y)):
        x_hat[k] = kalman.step(y[k], trajectories.u[k - 1])
    return x_hat


def kalman_filter(system: System, dt: float, process_noise: float, measurement_noise: Level) -> ExtendedKalmanFilter:
    """An extended Kalman filter that knows both levels of noise, and assumes a little process noise at least."""
    Q = process_intensity(system, process_noise, dt)
    return ExtendedKalmanFilter(system, dt, Q=Q, R=measurement_covariance(system, measurement_noise))


def measured(system: System, trajectories: UnseenTrajectories, level: Level, seed: int) -> np.ndarray:
    """Measure trajectories. Shapes: returns (steps + 1, n, ny)."""
    rng = generator(Stream.EVALUATION, seed, 1)
    return noisy_output(trajectories.plant or system, trajectories.x, measurement_noise=level, rng=rng)


def _errors(trajectories: UnseenTrajectories, x_hat: np.ndarray, dt: float, skip: float | None) -> Errors:
    x = trajectories.x
    first = round(TRANSIENT * len(x)) if skip is None else round(skip / dt)
    return Errors(smape(x, x_hat), smape(x, x_hat, first), nrmse(x, x_hat, first), trajectories.escaped)
