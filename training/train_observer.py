"""From a source of motions to an observer: all lessons in order, as ``kkl-gym train`` runs them."""

import dataclasses
import platform
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

import kkl_gym
from kkl_gym.system import System
from observers import Artifact, Motion
from observers.checks import noise_levels
from training.config import Config
from training.jobs import claimed_run
from training.lessons.calibrate import calibrate
from training.lessons.flow import learn_flow
from training.lessons.map import Maps, learn_map
from training.lessons.run import Run
from training.presets import preset
from training.progress import ProgressBars
from training.smoothness import check_continuous
from training.sources.simulated import SimulatedSource
from training.sources.source import Source, TooFewRunsError


@dataclass(frozen=True)
class Result:
    """What a training leaves behind.

    Parameters
    ----------
    artifact : Artifact
        The observer.
    losses : dict of str to list of (int, float)
        For each stage that trained a network, its error after so many batches.
    seconds : dict of str to float
        CPU seconds of each stage.
    """

    artifact: Artifact
    losses: dict[str, list[tuple[int, float]]]
    seconds: dict[str, float]


def train(
    source: System | Source,
    config: Config | None = None,
    folder: Path | None = None,
    *,
    resume: bool = False,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Result:
    """Learn an observer: a filter, T_inv, a motion to track by, covariances and the limits of a monitor.

    The lessons, in order: the map (:func:`training.learn_map`); the motion, which is the system's equations, or a
    learned flow where there are none or no expression can hold them (:func:`training.learn_flow`); the calibration
    (:func:`training.calibrate`). Each network has checkpoints of its own in ``folder``.

    Parameters
    ----------
    source : System or Source
        Where motions come from.
    config : Config, optional
        How; by default the system's preset "fast", or that of the source.
    folder : Path, optional
        Where checkpoints, a log and TensorBoard scalars go, created if missing; by default nothing is kept.
    resume : bool, default False
        Whether to go on from the checkpoints in ``folder`` if there are any; without it they are an error.
    device : torch.device, optional
        Where networks are trained; by default on a GPU if there is one.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown. By default it is shown nowhere, but for log.txt in ``folder``.

    Returns
    -------
    Result
        The observer, and how the errors fell.

    Raises
    ------
    ValueError
        If there are checkpoints, but not ``resume`` or not of this configuration, if another process is at work in the
        folder, if motions leave the system's bounds, or if a source comes with another configuration than its own.
    FloatingPointError
        If the loss is no longer a number.
    """
    if isinstance(source, System):
        source = SimulatedSource(source, config or preset(source))
    elif config not in (None, source.config):
        raise ValueError("a source has a configuration of its own: pass config with a System alone")
    config = source.config
    noise_levels("measurement_noise_max", config.measurement_noise_max, source.ny)
    if config.pipeline == "spinn" and isinstance(source, SimulatedSource):
        check_continuous(source.system)
    identity = {**source.identity(), **dataclasses.asdict(config)}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "run" if folder is None else folder
        began = time.process_time()
        with (
            claimed_run(folder, identity, resume),
            Run.begin(config, identity, folder, console=console, device=device, resume=resume) as run,
        ):
            maps = learn_map(source, run)
            motion = motion_of(source, run) if config.tracking and config.pipeline != "spinn" else None
            artifact = _artifact(maps, source, run)
            with run.timed("calibrating"):
                try:
                    artifact = calibrate(artifact, source, motion=motion, console=run.progress)
                except TooFewRunsError as reason:
                    run.progress.say(f"the observer has no covariances and does not track: {reason}")
            training = {
                **artifact.training,
                **source.judged(artifact),
                "cpu_seconds_spent": round(time.process_time() - began, 1),
            }
            return Result(dataclasses.replace(artifact, training=training), run.losses, dict(run.seconds))


def motion_of(source: Source, run: Run) -> Motion | None:
    """The motion of a tracker: the source's equations, or else a flow; None where such an observer cannot track."""
    try:
        parts = source.tracking()
    except ValueError as reason:
        run.progress.say(f"the observer does not track: {reason}")
        return None
    try:
        equations = source.equations()
    except ValueError as error:
        run.progress.say(f"the tracker moves by a learned flow: {error}")
        return learn_flow(source, run)
    return Motion(**parts, equations=equations)


def _artifact(maps: Maps, source: Source, run: Run) -> Artifact:
    """The observer, not calibrated yet, with how it was made."""
    return Artifact(
        **vars(maps),
        **source.facts() | ({} if maps.filter.nu else {"u_max": None}),
        training={
            **dataclasses.asdict(run.config),
            **run.samples,
            "device": run.device.type,
            "threads": torch.get_num_threads(),
            "resumed": run.resume,
        },
        versions={
            "kkl-gym": kkl_gym.__version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    )


__all__ = ["Result", "train"]
