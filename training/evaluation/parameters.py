"""How well an observer estimates the parameters of plants that it was trained for."""

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.checks import noise_levels
from training.evaluation.errors import TRANSIENT, unseen_trajectories
from training.evaluation.levels import Level
from training.seeds import Stream, generator
from training.trajectories.controllers import Controller
from training.trajectories.noise import noisy_output
from training.trajectories.parameters import blind, with_parameters


def parameter_errors(
    artifact: Artifact,
    system: System,
    *,
    plants: int,
    duration: float,
    measurement_noise: Level,
    seed: int,
    process_noise: float = 0.0,
    driven: bool = False,
    policy: Controller | None = None,
) -> np.ndarray:
    """Errors of estimated parameters after the transient, on plants drawn from the ranges of the training.

    Parameters
    ----------
    artifact : Artifact
        An observer that estimates parameters.
    system : System
        What it was made for.
    plants : int
        How many, each with a trajectory of its own.
    duration : float
        Length of each in seconds.
    measurement_noise : float or tuple of float, length ny
        Standard deviation of the noise on each sample of y, of all outputs or each.
    seed : int
        Seed of plants, starts, inputs and noise.
    process_noise : float
        Level of the process noise, in multiples of the system's scale per second.
    driven : bool
        As for :func:`training.evaluation.errors.unseen_trajectories`.
    policy : callable, optional
        As there.

    Returns
    -------
    ndarray, shape (number,)
        Root mean square error of each, in percent of the parameter's value.

    Raises
    ------
    ValueError
        If the artifact estimates no parameters, a level of noise is none or beyond its range, or every trajectory left
        the system's bounds.
    """
    plant = with_parameters(system, artifact.parameter_ranges)
    level = noise_levels("measurement_noise", measurement_noise, system.ny)
    observer = KKLObserver(artifact, level, process_noise=process_noise)
    trajectories = unseen_trajectories(
        plant,
        artifact.filter.dt,
        n=plants,
        duration=duration,
        seed=seed,
        driven=driven,
        process_noise=process_noise,
        policy=policy and blind(policy, system.nx),
    )
    if not trajectories.inside.any():
        raise ValueError(f"each of {plants} runs left bounds = {system.bounds}")
    rng = generator(Stream.EVALUATION, seed, 1)
    y = noisy_output(plant, trajectories.x, measurement_noise=level, rng=rng)
    found = observer.estimate_parameters(y, trajectories.u if artifact.nu else None)
    behind = [system.nx + [*artifact.parameter_ranges].index(name) for name in artifact.estimated_parameters]
    true = trajectories.x[0][:, behind]
    late = found[round(TRANSIENT * len(found)) :]
    error: np.ndarray = 100.0 * np.sqrt(np.mean((late / true - 1.0) ** 2, axis=(0, 1)))
    return error
