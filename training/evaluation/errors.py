"""Estimation errors of an observer on trajectories that its training never saw."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from kkl_gym.simulate import check_duration, simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.evaluation.metrics import smape
from training.seeds import Stream, generator
from training.trajectories.noise import draw_process_noise, noisy_output
from training.trajectories.signals import random_inputs

TRANSIENT = 0.2  # part of a trajectory that is left out of the errors "after the transient"

TRIES = 1000  # starts of which one at least should lie beyond X

Domain = Literal["X", "1.5X", "2X"]


class NoStartsError(ValueError):
    """A multiple of X holds no starts beyond X."""


@dataclass(frozen=True)
class Errors:
    """SMAPE in percent of each trajectory that stayed within bounds, and how many did not.

    Parameters
    ----------
    full : ndarray, shape (n,)
        Over all steps (the paper's).
    late : ndarray, shape (n,)
        After the transient: what :func:`errors` was told to skip, else the first 20 % of the steps.
    escaped : int
        Number of trajectories that left the system's declared bounds and are not in ``full`` and ``late``.
    """

    full: np.ndarray
    late: np.ndarray
    escaped: int


@dataclass(frozen=True)
class UnseenTrajectories:
    """Test trajectories, measured without noise.

    Parameters
    ----------
    x : ndarray, shape (steps + 1, n, nx)
        States of the trajectories that stayed within the system's declared bounds.
    u : ndarray, shape (steps, n, nu)
        Their inputs.
    inside : ndarray of bool, shape (drawn,)
        Which of the trajectories drawn these are.
    process_noise : float
        Level of their process noise, in multiples of the system's scale per second.
    """

    x: np.ndarray
    u: np.ndarray
    inside: np.ndarray
    process_noise: float = 0.0

    @property
    def escaped(self) -> int:
        """Number of trajectories that left the bounds."""
        return int((~self.inside).sum())

    def first(self, n: int) -> "UnseenTrajectories":
        """Take the first of those drawn.

        Drawn alone they might differ: rounding depends on the batch, and chaos on rounding.

        Parameters
        ----------
        n : int
            How many of those drawn, whether they stayed within bounds or not.

        Returns
        -------
        UnseenTrajectories
            Those of them that stayed.
        """
        inside = self.inside[:n]
        return UnseenTrajectories(self.x[:, : inside.sum()], self.u[:, : inside.sum()], inside, self.process_noise)


def starts(system: System, domain: Domain, n: int, rng: np.random.Generator) -> np.ndarray:
    """Starts, uniform in the training box X, or in a multiple of X (as in the paper) without X itself.

    Parameters
    ----------
    system : System
        Whose X is meant.
    domain : {"X", "1.5X", "2X"}
        Where to start.
    n : int
        Number of starts.
    rng : numpy.random.Generator
        From which they are drawn.

    Returns
    -------
    ndarray, shape (n, nx)
        The starts.

    Raises
    ------
    NoStartsError
        If there are hardly any beyond X.
    """
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
) -> UnseenTrajectories:
    """Simulate test trajectories, whose random numbers training never draws.

    Parameters
    ----------
    system : System
        What moves.
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
        Whether inputs act: random bounded steps and sines in turn.
    stream : Stream
        Random numbers to draw: those of evaluation or those of validation.
    process_noise : float
        Level of the process noise, in multiples of the system's scale per second.

    Returns
    -------
    UnseenTrajectories
        Those that stayed within the system's declared bounds, and which these are.

    Raises
    ------
    ValueError
        On an unknown domain, or unless n, duration, seed and level make sense.
    """
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
    if driven:
        u = random_inputs(system, n, steps, dt=dt, rng=rng, kinds=("steps", "sine"))
    w = None
    if process_noise:
        w = draw_process_noise(system, process_noise, n=n, steps=steps, rng=generator(stream, seed, 2))
    x = simulate(system, x0, steps, dt, u=u if driven else None, w=w)
    inside = np.isfinite(x[-1]).all(-1)
    return UnseenTrajectories(x[:, inside], u[:, inside], inside, process_noise)


def errors(
    artifact: Artifact,
    system: System,
    trajectories: UnseenTrajectories,
    *,
    measurement_noise: float | Sequence[float],
    seed: int,
    skip: float | None = None,
) -> Errors:
    """Errors of an observer on test trajectories. It is told the levels of noise.

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
    """
    rng = generator(Stream.EVALUATION, seed, 1)
    y = noisy_output(system, trajectories.x, measurement_noise=measurement_noise, rng=rng)
    observer = KKLObserver(artifact, measurement_noise, process_noise=trajectories.process_noise)
    x_hat = observer.estimate(y, trajectories.u if artifact.nu else None)
    first = round(TRANSIENT * len(y)) if skip is None else round(skip / artifact.filter.dt)
    return Errors(smape(trajectories.x, x_hat), smape(trajectories.x, x_hat, first), trajectories.escaped)
