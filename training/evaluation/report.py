"""The figure of a training: losses of the networks, and estimates along motions on which no network was trained."""

from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import KKLObserver
from training.config import settings_of
from training.evaluation.levels import show_level
from training.figures import ESTIMATE, TRUTH, drawing
from training.lessons import Result
from training.sources import Source, TooFewRunsError
from training.sources.simulated import SimulatedSource


def write_report(path: Path, result: Result, source: Source | System) -> None:
    """Draw the losses, and estimates along two calibration motions: simulated without and with noise, or recorded."""
    artifact = result.artifact
    if isinstance(source, System):
        source = SimulatedSource(source, settings_of(artifact.training))
    names = source.model.state_names if isinstance(source, SimulatedSource) else (artifact.signals or {})["hidden"]
    try:
        runs = source.runs(report=lambda done: None)
        # Recorded runs differ in length, and NaN fills up the shorter ones. Of the longest, one or two are drawn.
        length = np.isfinite(runs.x).all(-1).sum(0)
        by_noise = sorted(np.flatnonzero(length == length.max()).tolist(), key=lambda run: runs.process_noise[run])
        chosen = by_noise[:: max(1, len(by_noise) - 1)]  # the first and the last
    except TooFewRunsError:
        names, chosen = (), []
    with drawing(path, 12, 3.2 + 1.5 * len(names)) as figure:
        grid = figure.add_gridspec(1 + len(names), max(1, len(chosen)), height_ratios=[2.0, *[1.0] * len(names)])
        ax: Any = figure.add_subplot(grid[0, :])
        for name, history in result.losses.items():
            ax.semilogy(*np.array(history).T, label=name)
        ax.set(xlabel="batch", ylabel="error", title=f"{artifact.system}, {artifact.training['pipeline']}")
        ax.legend()
        for column, (run, level) in enumerate(zip(chosen, (0.0, artifact.measurement_noise))):
            x, y, u = runs.x[:, run], runs.y[:, run], runs.u[:, run] if artifact.nu else None
            y = y + np.asarray(level) * np.random.default_rng(0).standard_normal(y.shape)
            process_noise, t = float(runs.process_noise[run]), np.arange(len(x)) * artifact.filter.dt
            observer = KKLObserver(artifact, level, process_noise=process_noise, compiled=False)
            x_hat = np.where(np.isnan(x), np.nan, observer.estimate(y, u))
            for i, name in enumerate(names):
                ax = figure.add_subplot(grid[1 + i, column], ylabel=name)
                ax.plot(t, x[:, i], color=TRUTH, lw=1.8, label="true")
                ax.plot(t, x_hat[:, i], "--", color=ESTIMATE, label="estimated")
                if i == 0:
                    noise = f"measurement noise {show_level(level)}, process noise {process_noise:g}"
                    ax.set_title("as recorded" if artifact.signals else noise, loc="left")
                    ax.legend(loc="upper right")
            ax.set_xlabel("t in s")
