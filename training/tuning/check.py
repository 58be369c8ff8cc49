"""Whether predictions hold: observers trained for several spectra, on runs that nobody trained on."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

from kkl_gym.system import System
from observers.checks import noise_levels
from training.evaluation.errors import errors, unseen_trajectories
from training.evaluation.levels import Level, multiple
from training.pipeline import train
from training.presets import preset
from training.seeds import Stream
from training.spectrum import Spectrum

LEAST_NOISE = 0.02  # of the system's own, that a map is trained for, also where none is expected
HEADROOM = 4.0  # of the noise that a map is trained for over the noise that is expected: it does better so
TRAJECTORIES = 500  # of each training
RUNS = 50  # on which its observer is measured


def settings(system: System, spectrum: Spectrum, measurement_noise: Level) -> dict[str, Any]:
    """Find the settings of a :class:`training.config.Config` that make an observer for some noise.

    Parameters
    ----------
    system : System
        To be observed.
    spectrum : Spectrum
        Of its filter.
    measurement_noise : float or tuple of float, length ny
        Standard deviation that is expected on each sample of y, of all outputs or each.

    Returns
    -------
    dict
        Settings by name; the others are the preset's.
    """
    largest = np.maximum(HEADROOM * np.asarray(measurement_noise), multiple(system, LEAST_NOISE))
    return {
        "eigenvalues": spectrum.eigenvalues,
        "pairs": spectrum.pairs,
        "measurement_noise_max": noise_levels("measurement_noise_max", largest, system.ny),
        "noise_free_share": 0.05 if np.any(measurement_noise) else 0.9,
        "high_noise_emphasis": 4.0,
    }


def trained_error(
    system: System, spectrum: Spectrum, *, measurement_noise: Level, seconds: float, dt: float, duration: float
) -> float:
    """Train an observer of free motion and measure what it leaves.

    Parameters
    ----------
    system : System
        To be observed.
    spectrum : Spectrum
        Of the filter.
    measurement_noise : float or tuple of float, length ny
        Standard deviation of the noise on each sample of y, of all outputs or each.
    seconds : float
        CPU time of the training.
    dt : float
        Sampling interval in seconds.
    duration : float
        Length of each run in seconds.

    Returns
    -------
    float
        Median SMAPE in percent, over all steps of runs that nobody trained on.
    """
    config = replace(
        preset(system, "input-aware", "fast"),
        **settings(system, spectrum, measurement_noise),
        inputs=False,
        trajectories=TRAJECTORIES,
        dt=dt,
        duration=duration,
        inverse_steps=10**6,
        cpu_seconds=seconds,
    )
    with TemporaryDirectory() as folder:
        artifact = train(system, config, Path(folder), device=torch.device("cpu")).artifact
    runs = unseen_trajectories(system, dt, n=RUNS, duration=duration, seed=0, stream=Stream.VALIDATION)
    return float(np.median(errors(artifact, system, runs, measurement_noise=measurement_noise, seed=0).full))


def rank_correlation(predicted: Sequence[float], measured: Sequence[float]) -> float:
    """Spearman's rank correlation.

    Parameters
    ----------
    predicted, measured : sequences of float
        As many of each.

    Returns
    -------
    float
        NaN for fewer than three pairs, which tell nothing.
    """
    return float(spearmanr(predicted, measured).statistic) if len(predicted) > 2 else np.nan
