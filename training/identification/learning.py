"""Identification of a plant and training of its observer: :func:`identify` and :func:`adapt`."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from kkl_gym.system import System
from observers import Artifact
from observers.checks import check_dt
from training.config import Config, settings_of
from training.files import claimed_job, refuse_checkpoints, write
from training.identification.identify import Identified, Limits, estimate_parameters
from training.identification.report import write_report
from training.lessons import Result, train
from training.presets import preset
from training.progress import LOG, ProgressBars, progress_bars
from training.records import Record, check_signals, resampled, sampling_interval
from training.records import check_dt as check_steps
from training.trajectories.equations import describe

NOISE_RANGE = 2.0  # largest noise level in the observer's training, in multiples of the records' noise level
LEAST_NOISE = 0.002  # lower bound of this largest noise level, as a share of the output's range
OBSERVER_FOLDER = "observer"


@dataclass(frozen=True)
class Learned:
    """Identified parameters, and the observer that was trained for them."""

    identified: Identified
    result: Result


def identify(
    system: System,
    unknown: Limits,
    records: Sequence[Record],
    folder: Path,
    *,
    dt: float | None = None,
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    resume: bool = False,
    console: Console | ProgressBars | None = None,
) -> Learned:
    """Identify parameters of a plant from records of its outputs, and train an observer for it.

    No recorded state is needed. :func:`training.identification.identify.estimate_parameters` fits the parameters. The
    observer is trained on simulated motions of the identified plant, with noise up to at least twice the recorded one.

    Parameters
    ----------
    system : System
        The model, with first guesses of its parameters.
    unknown : mapping of str to (float, float)
        (low, high) limits of each unknown parameter.
    records : sequence of Record
        Outputs of one plant, and its inputs if they acted.
    folder : Path
        Folder for parameters.json, identification.png, SYSTEM.safetensors, checkpoints and log.txt.
    dt : float, optional
        Sampling interval of the observer in seconds; by default the records' interval.
    settings : mapping of str to object, optional
        Settings of :class:`training.Config` for the observer.
    seed : int
        Seed of the initial states that the fit tries for each window, and of the observer's training.
    resume : bool
        Whether to resume from checkpoints in the folder.
    console : Console or ProgressBars, optional
        Shows the progress; by default only log.txt has it.

    Returns
    -------
    Learned
        Parameters and observer, which are also in the folder.

    Raises
    ------
    ValueError
        If an argument is invalid, the folder holds another run, or the model explains no window of the records.
    """
    check_signals(records, system)
    interval = sampling_interval(*records) if dt is None else check_dt(dt)
    given = {"dt": interval, "seed": seed, **(settings or {})}
    # Invalid settings raise an error before the identification, which may take long.
    preset(system, "input-aware", "fast", changes={"eigenvalues": (-1.0,), **given})
    inputs = bool(system.nu) and records[0].u is not None

    def configured(found: Identified) -> Config:
        size = np.asarray(found.system.output_range)
        quiet = bool((found.noise < LEAST_NOISE * size / NOISE_RANGE).all())
        changes = {
            "duration": 5000 * interval,
            "inputs": inputs,
            "measurement_noise_max": _level(np.maximum(NOISE_RANGE * found.noise, LEAST_NOISE * size)),
            "noise_free_share": 0.5 if quiet else 0.2,
            "high_noise_emphasis": 2.0 if quiet else 4.0,
            **given,
        }
        return preset(found.system, "input-aware", "fast", changes=changes)

    found, result = _learned(
        system, unknown, records, folder, configured, dt=interval, seed=seed, resume=resume, console=console
    )
    artifact = dataclasses.replace(result.artifact, measurement_noise=_level(np.maximum(found.noise, 0.0)))
    artifact.save(folder / f"{system.name}.safetensors")
    return Learned(found, dataclasses.replace(result, artifact=artifact))


def adapt(
    observer: Artifact,
    system: System,
    records: Sequence[Record],
    folder: Path,
    *,
    unknown: Limits,
    settings: Mapping[str, Any] | None = None,
    resume: bool = False,
    console: Console | ProgressBars | None = None,
) -> Learned:
    """Identify a plant that differs from an observer's model, and train a new observer for this plant.

    The training uses the given observer's settings, including its noise levels.

    Parameters
    ----------
    observer : Artifact
        The observer.
    system : System
        The observer's model; its parameters are the first guesses.
    records : sequence of Record
        Outputs of one plant, and its inputs if they acted.
    folder : Path
        As for :func:`identify`.
    unknown : mapping of str to (float, float)
        (low, high) limits of each parameter that may differ.
    settings : mapping of str to object, optional
        Settings of :class:`training.Config` that replace the observer's.
    resume : bool
        Whether to resume from checkpoints in the folder.
    console : Console or ProgressBars, optional
        Shows the progress; by default only log.txt has it.

    Returns
    -------
    Learned
        Parameters and observer.

    Raises
    ------
    ValueError
        As for :func:`identify`, and if the observer holds no settings of a training, or estimates a bias.
    """
    config = settings_of(observer.training, **(settings or {}))
    if np.any(config.bias):
        raise ValueError(
            f"this observer estimates a bias of up to {config.bias}, but identification does not: pass bias = 0, or "
            "identify the parameters from records without a bias and train again"
        )
    dt, seed = observer.filter.dt, config.seed
    found, result = _learned(
        system, unknown, records, folder, lambda found: config, dt=dt, seed=seed, resume=resume, console=console
    )
    result.artifact.save(folder / f"{system.name}.safetensors")
    return Learned(found, result)


def _learned(
    system: System,
    unknown: Limits,
    records: Sequence[Record],
    folder: Path,
    configured: Callable[[Identified], Config],
    *,
    dt: float,
    seed: int,
    resume: bool,
    console: Console | ProgressBars | None,
) -> tuple[Identified, Result]:
    """Identify the parameters, write them to the folder, and train the observer."""
    check_steps(records, dt)
    uniform = [resampled(record, dt) for record in records]
    fingerprints = [record.fingerprint for record in records]
    identity = {**describe(system), "unknown": dict(unknown), "seed": seed, "dt": dt, "records": fingerprints}
    if not resume:
        refuse_checkpoints(folder / OBSERVER_FOLDER)
    claimed = claimed_job(folder, identity, "a run of another configuration")
    with claimed, progress_bars(console, folder / LOG) as progress:
        found = estimate_parameters(system, unknown, uniform, progress=progress, seed=seed)
        for line in found.summary():
            progress.say(line)
        write(folder / "parameters.json", json.dumps(found.to_json(), indent=2) + "\n")
        with progress.phase("drawing identification.png"):
            write_report(folder / "identification.png", found)
    return found, train(found.system, configured(found), folder / OBSERVER_FOLDER, resume=resume, console=console)


def _level(noise: np.ndarray) -> float | tuple[float, ...]:
    """Return noise levels in the form of artifacts and settings: a number for one output, else a tuple."""
    return float(noise[0]) if len(noise) == 1 else tuple(noise.tolist())
