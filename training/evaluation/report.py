"""The picture of a training: errors of the networks, and estimates of held-out motions."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.config import settings_of
from training.evaluation.errors import follow
from training.evaluation.levels import Level, show_level
from training.figures import ESTIMATE, TRUTH, drawing
from training.lessons import Result
from training.sources import Runs, Source, TooFewRunsError
from training.sources.simulated import SimulatedSource

RUNS = 100  # simulated motions
OTHER_SEED = 2**31  # added to that of the training


def write_report(path: Path, result: Result, source: Source | System) -> None:
    """Draw the losses, and estimates of held-out motions with their errors.

    Simulated motions are neither of the training nor of the calibration, but of the same kinds. Recorded ones are those
    of the calibration.
    """
    artifact = result.artifact
    if isinstance(source, System):
        source = SimulatedSource(source, settings_of(artifact.training))
    runs, usual = held_out(source), artifact.measurement_noise
    levels: list[Level] = [0.0, usual] if np.any(usual) else [0.0]
    names = source.model.state_names if isinstance(source, SimulatedSource) else (artifact.signals or {})["hidden"]
    rows = len(names) if runs else 0
    with drawing(path, 12, 3.2 + 1.5 * rows) as figure:
        grid = figure.add_gridspec(1 + rows, 2, height_ratios=[2.0, *[1.0] * rows])
        ax = figure.add_subplot(grid[0, :])
        for name, history in result.losses.items():
            ax.semilogy(*np.array(history).T, label=name)
        ax.set(xlabel="batch", ylabel="error", title=f"{artifact.system}, {artifact.training['pipeline']}")
        ax.legend()
        for column, level in enumerate((levels[0], levels[-1]) if runs else ()):
            assert runs is not None
            run = int((np.argmin, np.argmax)[column](runs.process_noise))
            axes = [figure.add_subplot(grid[1 + i, column]) for i in range(rows)]
            noise = f"measurement noise {show_level(level)}, process noise {runs.process_noise[run]:g}"
            axes[0].set_title("as recorded" if artifact.signals else noise, loc="left")
            draw_estimates(axes, names, runs.x, followed(artifact, runs, level), run=run, dt=artifact.filter.dt)


def held_out(source: Source) -> Runs | None:
    """Motions that the training did not use; None where none were held out."""
    if isinstance(source, SimulatedSource):
        config = replace(source.config, seed=(source.config.seed + OTHER_SEED) % 2**32, runs=RUNS)
        source = SimulatedSource(source.system, config)
    try:
        return source.runs(report=lambda done: None)
    except TooFewRunsError:
        return None


def followed(artifact: Artifact, runs: Runs, level: Level) -> np.ndarray:
    """Estimates along runs at a level of measurement noise."""
    x_hat = np.empty_like(runs.x)
    y = runs.y + np.asarray(level) * np.random.default_rng(0).standard_normal(runs.y.shape)
    for noise in np.unique(runs.process_noise):
        rows = runs.process_noise == noise
        observer = KKLObserver(artifact, level, process_noise=float(noise), compiled=False)
        x_hat[:, rows], _ = follow(observer, y[:, rows], runs.u[:, rows])
    return x_hat


def draw_estimates(
    axes: list[Any], names: Sequence[str], x: np.ndarray, x_hat: np.ndarray, *, run: int, dt: float
) -> None:
    """Draw the states of a run and their estimates, with the errors in the second half of all runs."""
    moving, t = np.ma.masked_invalid(x), np.arange(len(x)) * dt
    late = ((moving - x_hat)[len(x) // 2 :] ** 2).mean((0, 1))
    errors = (100 * np.ma.sqrt(late) / moving.std((0, 1))).filled(np.nan)  # NaN where a state does not move
    estimated = np.where(np.isnan(x), np.nan, x_hat)  # recorded runs differ in length
    for ax, i, error in zip(axes, range(len(names)), errors):
        ax.plot(t, x[:, run, i], color=TRUTH, lw=1.8, label="true")
        ax.plot(t, estimated[:, run, i], "--", color=ESTIMATE, label="estimated")
        ax.set_ylabel(names[i])
        ax.set_title(f"rms error {error:.2g} %", loc="right")
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("t in s")
