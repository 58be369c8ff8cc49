"""The picture of a training: errors of the networks, and estimates of motions that they were not trained on."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.config import settings_of
from training.evaluation.levels import show_level
from training.figures import ESTIMATE, TRUTH, drawing
from training.lessons import Result
from training.sources import Runs, Source, TooFewRunsError
from training.sources.simulated import SimulatedSource


def write_report(path: Path, result: Result, source: Source | System) -> None:
    """Draw the losses, and estimates of the motions of the calibration, without noise and with the usual."""
    artifact = result.artifact
    if isinstance(source, System):
        source = SimulatedSource(source, settings_of(artifact.training))
    runs: Runs | None = None
    with suppress(TooFewRunsError):
        runs = source.runs(report=lambda done: None)
    names = source.model.state_names if isinstance(source, SimulatedSource) else (artifact.signals or {})["hidden"]
    rows = len(names) if runs else 0
    with drawing(path, 12, 3.2 + 1.5 * rows) as figure:
        grid = figure.add_gridspec(1 + rows, 2, height_ratios=[2.0, *[1.0] * rows])
        ax = figure.add_subplot(grid[0, :])
        for name, history in result.losses.items():
            ax.semilogy(*np.array(history).T, label=name)
        ax.set(xlabel="batch", ylabel="error", title=f"{artifact.system}, {artifact.training['pipeline']}")
        ax.legend()
        if runs is None:
            return
        for column, level in enumerate((0.0, artifact.measurement_noise)):
            process_noise = float((np.min, np.max)[column](runs.process_noise))
            axes = [figure.add_subplot(grid[1 + i, column]) for i in range(rows)]
            for ax, name in zip(axes, names, strict=True):
                ax.set_ylabel(name)
            noise = f"measurement noise {show_level(level)}, process noise {process_noise:g}"
            axes[0].set_title("as recorded" if artifact.signals else noise, loc="left")
            draw_estimates(axes, artifact, runs, level, process_noise)


def draw_estimates(
    axes: list[Any], artifact: Artifact, runs: Runs, measurement_noise: Any, process_noise: float
) -> None:
    """Draw one of the runs of a level of process noise, its estimates, and errors in the second half of all of them."""
    x, y, u = (each[:, runs.process_noise == process_noise] for each in (runs.x, runs.y, runs.u))
    observer = KKLObserver(artifact, measurement_noise, process_noise=process_noise, compiled=False)
    y = y + np.asarray(measurement_noise) * np.random.default_rng(0).standard_normal(y.shape)
    x_hat = observer.estimate(y, u if artifact.nu else None)
    moving, t = np.ma.masked_invalid(x), np.arange(len(x)) * artifact.filter.dt
    late = ((moving - x_hat)[len(x) // 2 :] ** 2).mean((0, 1))
    errors = (100 * np.ma.sqrt(late) / moving.std((0, 1))).filled(np.nan)  # NaN where a state does not move
    estimated = np.where(np.isnan(x), np.nan, x_hat)  # recorded runs differ in length
    for i, ax in enumerate(axes):
        ax.plot(t, x[:, 0, i], color=TRUTH, lw=1.8, label="true")
        ax.plot(t, estimated[:, 0, i], "--", color=ESTIMATE, label="estimated")
        ax.set_title(f"rms error {errors[i]:.2g} %", loc="right")
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("t in s")
