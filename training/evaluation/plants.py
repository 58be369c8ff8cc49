"""Plants with other parameters than the model, and how well an observer estimates these."""

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.checks import is_finite, noise_levels, shown
from training.evaluation.errors import TRANSIENT, measured, unseen_trajectories
from training.evaluation.levels import Level
from training.trajectories.motions import Controller
from training.trajectories.parameters import blind, with_parameters


def off_by(system: System, share: float) -> System:
    """The same system with every parameter larger by a share of itself."""
    if not is_finite(share):
        raise ValueError(f"the error of the parameters must be a finite number, as 0.1 is, got {shown(share)}")
    if not system.parameters:
        raise ValueError(f"{system.name} has no parameters that could be off")
    return system.replace({name: (1.0 + share) * value for name, value in system.parameters.items()})


def show_parameters(system: System) -> str:
    """For titles and tables: ``mu=3.3``, with spaces between several."""
    return " ".join(f"{name}={value:g}" for name, value in system.parameters.items())


def show_ranges(artifact: Artifact) -> str:
    """``mu from 2.7 to 3.3``, with commas between several parameters; empty without any."""
    return ", ".join(f"{name} from {low:g} to {high:g}" for name, (low, high) in artifact.parameter_ranges.items())


def parameter_errors(
    artifact: Artifact,
    system: System,
    *,
    trajectories: int,
    duration: float,
    measurement_noise: Level,
    seed: int,
    process_noise: float = 0.0,
    driven: bool = False,
    policy: Controller | None = None,
    plant: System | None = None,
) -> np.ndarray:
    """Errors of estimated parameters after the transient, on a plant or on many from the ranges of the training."""
    nx, estimated = system.nx, artifact.estimated_parameters
    moving = plant or with_parameters(system, {name: artifact.parameter_ranges[name] for name in estimated})
    level = noise_levels("measurement_noise", measurement_noise, system.ny)
    observer = KKLObserver(artifact, level, process_noise=process_noise)
    runs = unseen_trajectories(
        moving,
        artifact.filter.dt,
        n=trajectories,
        duration=duration,
        seed=seed,
        driven=driven,
        process_noise=process_noise,
        policy=policy and blind(policy, nx),
    )
    if not runs.inside.any():
        raise ValueError(f"each of {trajectories} runs left bounds = {system.bounds}")
    y = measured(moving, runs, level, seed)
    found = observer.estimate_parameters(y, runs.u if artifact.nu else None)
    true = [plant.parameters[name] for name in estimated] if plant else runs.x[0, :, nx:]
    late = found[round(TRANSIENT * len(found)) :]
    error: np.ndarray = 100.0 * np.sqrt(np.mean((late / true - 1.0) ** 2, axis=(0, 1)))
    return error
