"""An observer for a plant of which outputs were recorded: its parameters, then its map."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from kkl_gym.system import System
from observers import Artifact
from observers.checks import check_dt
from observers.storage import write
from training.config import Config, override, settings_of
from training.identification.identify import Identified, Limits, estimate_parameters
from training.identification.report import write_report
from training.jobs import claimed_run, describe
from training.pipeline import Result, train
from training.presets import preset
from training.progress import LOG, ProgressBars, progress_bars
from training.records import Record, check_signals, resampled, sampling_interval
from training.records import check_dt as check_steps

NOISE_RANGE = 2.0  # largest measurement noise that a map is made for, over what the records show
LEAST_NOISE = 0.002  # the same, over the output's range, where they show hardly any
INVERSE_STEPS = 12_000
OBSERVER_FOLDER = "observer"


@dataclass(frozen=True)
class Learned:
    """What records of outputs taught."""

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
    """Learn parameters of a plant, and an observer for it, from records of its outputs. No state is ever seen.

    The parameters come from :func:`training.identification.identify.estimate_parameters`. The observer then is trained
    on simulated motions of the plant that was identified, for noise up to twice what the records show.

    Parameters
    ----------
    system : System
        The model, with first guesses of its parameters.
    unknown : mapping of str to (float, float)
        Lowest and highest value of each parameter that is unknown.
    records : sequence of Record
        Outputs, and inputs where they acted, of one plant.
    folder : Path
        Receives parameters.json, identification.png, SYSTEM.safetensors, checkpoints and log.txt.
    dt : float, optional
        Sampling interval of the observer in seconds; by default that of the records.
    settings : mapping of str to object, optional
        Settings of :class:`training.Config` for the observer.
    seed : int
        Of everything random.
    resume : bool
        Whether to go on from checkpoints in the folder.
    console : Console or ProgressBars, optional
        Where progress is shown; by default nowhere but in log.txt.

    Returns
    -------
    Learned
        Parameters and observer, which are in the folder as well.

    Raises
    ------
    ValueError
        If the records, or the parameters' names or limits, make no sense; see
        :func:`training.identification.identify.estimate_parameters`.
    """
    check_signals(records, system)
    interval = sampling_interval(*records) if dt is None else check_dt(dt)
    given = {"dt": interval, "seed": seed, **(settings or {})}
    preset(system, "input-aware", "fast", changes={"eigenvalues": (-1.0,), **given})  # bad settings are refused early
    found = _parameters(system, unknown, records, folder, dt=interval, seed=seed, resume=resume, console=console)
    inputs = bool(system.nu) and records[0].u is not None
    size = np.asarray(found.system.output_range)
    largest = np.maximum(NOISE_RANGE * found.noise, LEAST_NOISE * size)
    quiet = bool((found.noise < LEAST_NOISE * size / NOISE_RANGE).all())
    changes: dict[str, Any] = {
        "duration": 5000 * interval,
        "inputs": inputs,
        "inverse_steps": INVERSE_STEPS,
        "measurement_noise_max": float(largest[0]) if len(largest) == 1 else tuple(largest.tolist()),
        "noise_free_share": 0.5 if quiet else 0.2,
        "high_noise_emphasis": 2.0 if quiet else 4.0,
        **given,
    }
    config = preset(found.system, "input-aware", "fast", changes=changes)
    return _observer(found, config, folder, noise=found.noise, resume=resume, console=console)


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
    """Learn an observer anew for a plant that differs from its model, from records of outputs.

    The observer's estimates take the place of the network from which :func:`identify` begins. What was chosen for its
    training, noise levels among it, is chosen again.

    Parameters
    ----------
    observer : Artifact
        The observer.
    system : System
        What it was made for.
    records : sequence of Record
        Outputs, and inputs where they acted, of one plant.
    folder : Path
        As for :func:`identify`.
    unknown : mapping of str to (float, float)
        Lowest and highest value of each parameter that may differ.
    settings : mapping of str to object, optional
        Settings of :class:`training.Config` that are to differ from those of the observer.
    resume : bool
        Whether to go on from checkpoints in the folder.
    console : Console or ProgressBars, optional
        Where progress is shown; by default nowhere but in log.txt.

    Returns
    -------
    Learned
        Parameters and observer.

    Raises
    ------
    ValueError
        As for :func:`identify`, and if the observer's settings are not those of a training.
    """
    config = override(settings_of(observer.training), settings or {})
    dt, seed = observer.filter.dt, config.seed
    found = _parameters(system, unknown, records, folder, dt=dt, seed=seed, resume=resume, console=console)
    return _observer(found, config, folder, noise=None, resume=resume, console=console)


def _parameters(
    system: System,
    unknown: Limits,
    records: Sequence[Record],
    folder: Path,
    *,
    dt: float,
    seed: int,
    resume: bool,
    console: Console | ProgressBars | None,
) -> Identified:
    """Identify, and write what was found."""
    check_steps(records, dt)
    uniform = [resampled(record, dt) for record in records]
    identity = {
        **describe(system),
        "unknown": dict(unknown),
        "seed": seed,
        "dt": dt,
        "records": [record.fingerprint for record in records],
    }
    with claimed_run(folder, identity, resume), progress_bars(console, folder / LOG) as progress:
        found = estimate_parameters(system, unknown, uniform, progress=progress, seed=seed)
        for line in found.told():
            progress.say(line)
        write(folder / "parameters.json", json.dumps(found.to_json(), indent=2) + "\n")
        with progress.phase("drawing what was identified"):
            write_report(folder / "identification.png", found)
    return found


def _observer(
    found: Identified,
    config: Config,
    folder: Path,
    *,
    noise: np.ndarray | None,
    resume: bool,
    console: Console | ProgressBars | None,
) -> Learned:
    """Train the observer for the plant that was identified, and write it."""
    result = train(found.system, config, folder / OBSERVER_FOLDER, resume=resume, console=console)
    artifact = result.artifact
    if noise is not None:
        usual = np.maximum(noise, 0.0)
        artifact = dataclasses.replace(
            artifact, measurement_noise=float(usual[0]) if len(usual) == 1 else tuple(usual.tolist())
        )
    artifact.save(folder / f"{found.system.name}.safetensors")
    return Learned(found, dataclasses.replace(result, artifact=artifact))
