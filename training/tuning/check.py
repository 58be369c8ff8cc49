"""Whether predictions hold: observers trained for several spectra, on runs that nobody trained on."""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

import kkl_gym
from kkl_gym.system import System
from kkl_gym.systems import get_system
from observers.checks import noise_levels
from observers.storage import explained, write
from training.evaluation.errors import errors, unseen_trajectories
from training.evaluation.levels import Level, multiple
from training.jobs import claimed_job, describe
from training.pipeline import train
from training.presets import preset
from training.seeds import Stream
from training.spectrum import Spectrum

LEAST_NOISE = 0.02  # of the system's own, that a map is trained for, also where none is expected
HEADROOM = 4.0  # of the noise that a map is trained for over the noise that is expected: it does better so
TRAJECTORIES = 500  # of each training
RUNS = 50  # on which its observer is measured


def settings(system: System, spectrum: Spectrum, measurement_noise: Level) -> dict[str, Any]:
    """Find the settings of a :class:`training.config.Config` that make an observer for some noise."""
    largest = np.maximum(HEADROOM * np.asarray(measurement_noise), multiple(system, LEAST_NOISE))
    return {
        "eigenvalues": spectrum.eigenvalues,
        "pairs": spectrum.pairs,
        "measurement_noise_max": noise_levels("measurement_noise_max", largest, system.ny),
        "noise_free_share": 0.05 if np.any(measurement_noise) else 0.9,
        "high_noise_emphasis": 4.0,
    }


@dataclass(frozen=True)
class Trial:
    """An observer of free motion, trained for a spectrum: a job."""

    system: str
    parameters: Mapping[str, float]
    spectrum: Spectrum
    measurement_noise: Level
    seconds: float
    dt: float
    duration: float
    out: Path

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What makes its result what it is."""
        of = {key: value for key, value in asdict(self).items() if key not in ("system", "parameters", "out")}
        system = describe(get_system(self.system, self.parameters))
        return {**of, "system": system, "trajectories": TRAJECTORIES, "version": kkl_gym.__version__}

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.spectrum.modes} modes"

    @cached_property
    def folder(self) -> Path:
        """One of its own: a trial of anything else has another."""
        return self.out / hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def done(self) -> bool:
        """Whether its result lies there."""
        return (self.folder / "error.json").exists()

    @property
    def error(self) -> float:
        """Median SMAPE in percent, over all steps of runs that nobody trained on."""
        path = self.folder / "error.json"
        with explained(path, ValueError):
            return float(json.loads(path.read_text()))


def run_trial(trial: Trial) -> None:
    """Train an observer and measure what it leaves, unless that is done; goes on where an earlier run stopped."""
    torch.set_num_threads(1)
    system = get_system(trial.system, trial.parameters)
    config = replace(
        preset(system, "input-aware", "fast"),
        **settings(system, trial.spectrum, trial.measurement_noise),
        inputs=False,
        trajectories=TRAJECTORIES,
        dt=trial.dt,
        duration=trial.duration,
        inverse_steps=10**6,
        cpu_seconds=trial.seconds,
    )
    with claimed_job(trial.folder, trial.identity, "another trial"):
        if trial.done:
            return
        training = trial.folder / "training"
        artifact = train(system, config, training, device=torch.device("cpu"), resume=True).artifact
        runs = unseen_trajectories(system, trial.dt, n=RUNS, duration=trial.duration, seed=0, stream=Stream.VALIDATION)
        found = errors(artifact, system, runs, measurement_noise=trial.measurement_noise, seed=0).full
        write(trial.folder / "error.json", json.dumps(float(np.median(found))) + "\n")
        shutil.rmtree(training)


def rank_correlation(predicted: Sequence[float], measured: Sequence[float]) -> float:
    """Spearman's rank correlation."""
    return float(spearmanr(predicted, measured).statistic) if len(predicted) > 2 else np.nan
