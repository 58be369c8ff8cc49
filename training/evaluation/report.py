"""A training in one picture."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.factors import COVERAGE
from training.calibration import chi_square, squared_distance
from training.config import settings_of
from training.evaluation.errors import follow
from training.evaluation.levels import Level, show_level
from training.figures import ESTIMATE, TRUTH, drawing
from training.lessons import Result
from training.maps.forward import residual
from training.sources.simulated import SimulatedSource
from training.sources.source import Runs, Source, TooFewRunsError

RUNS = 100  # simulated motions
OTHER_SEED = 2**31  # added to that of the training
SPANS = 24  # of age, over which covariances are judged
POINTS = 150  # along each axis, at which the residual is drawn


def write_report(path: Path, result: Result, source: Source | System) -> None:
    """Draw the errors in training, how true the covariances are, T's PDE residual, and estimates of held-out motions.

    Simulated motions are other ones than those of training and calibration, of the same kinds. Recorded ones are those
    on which covariances were calibrated.
    """
    artifact = result.artifact
    if isinstance(source, System):
        source = SimulatedSource(source, settings_of(artifact.training))
    runs = held_out(source)
    usual = artifact.measurement_noise
    levels: list[Level] = [0.0, usual] if np.any(usual) else [0.0]
    followed = [Followed(artifact, runs, level) for level in levels] if runs else []
    panels: list[Callable[[Any], None]] = [partial(draw_losses, result=result)]
    if followed and artifact.inverse.error_covariance is not None:
        panels.append(partial(draw_coverage, followed=followed))
    if artifact.forward is not None and isinstance(source, SimulatedSource):
        panels.append(partial(draw_residual, artifact=artifact, system=source.system))
    states = artifact.nx if followed else 0
    with drawing(path, 12, 3.2 + 1.5 * states) as figure:
        grid = figure.add_gridspec(1 + states, 6, height_ratios=[2.0, *[1.0] * states])
        width = 6 // len(panels)
        for i, draw in enumerate(panels):
            draw(figure.add_subplot(grid[0, i * width : (i + 1) * width]))
        # Of simulated runs the first has no process noise, and the second half has.
        for column, (each, run) in enumerate([(followed[0], 0), (followed[-1], RUNS // 2)] if followed else []):
            axes = [figure.add_subplot(grid[1 + i, 3 * column : 3 * column + 3]) for i in range(states)]
            each.draw(axes, run % each.x.shape[1], state_names(source, artifact), recorded=artifact.signals is not None)


def held_out(source: Source) -> Runs | None:
    """Motions that were not trained on; None where none were held out."""
    if isinstance(source, SimulatedSource):
        config = replace(source.config, seed=(source.config.seed + OTHER_SEED) % 2**32, runs=RUNS)
        source = SimulatedSource(source.system, config)
    try:
        return source.runs(report=lambda done: None)
    except TooFewRunsError:
        return None


def state_names(source: Source, artifact: Artifact) -> tuple[str, ...]:
    """Names of the states."""
    if isinstance(source, SimulatedSource):
        return source.model.state_names
    return tuple((artifact.signals or {})["hidden"])


class Followed:
    """Estimates along runs at a level of measurement noise; squared distances of the errors by their covariances."""

    def __init__(self, artifact: Artifact, runs: Runs, level: Level) -> None:
        self.level, self.runs, self.x, self.dt = level, runs, runs.x, artifact.filter.dt
        self.x_hat, self.distances = np.empty_like(runs.x), np.full(runs.x.shape[:2], np.nan)
        y = runs.y + np.asarray(level) * np.random.default_rng(0).standard_normal(runs.y.shape)
        judged = artifact.inverse.error_covariance is not None
        for noise in np.unique(runs.process_noise):
            rows = runs.process_noise == noise
            observer = KKLObserver(artifact, level, process_noise=float(noise), compiled=False)
            self.x_hat[:, rows], covariance = follow(observer, y[:, rows], runs.u[:, rows], covariances=judged)
            if covariance is not None:
                self.distances[:, rows] = squared_distance(self.x[:, rows] - self.x_hat[:, rows], covariance)

    def draw(self, axes: list[Any], run: int, names: tuple[str, ...], *, recorded: bool) -> None:
        """Draw the states of a run and their estimates."""
        t, x, x_hat = np.arange(len(self.x)) * self.dt, self.x[:, run], self.x_hat[:, run]
        x_hat = np.where(np.isnan(x), np.nan, x_hat)  # recorded runs differ in length
        for ax, i, error in zip(axes, range(len(names)), self.errors()):
            ax.plot(t, x[:, i], color=TRUTH, lw=1.8, label="true")
            ax.plot(t, x_hat[:, i], "--", color=ESTIMATE, label="estimated")
            ax.set_ylabel(names[i])
            ax.set_title(f"rms error {error:.2g} %", loc="right")
        noise = f"measurement noise {show_level(self.level)}, process noise {self.runs.process_noise[run]:g}"
        axes[0].set_title("as recorded" if recorded else noise, loc="left")
        axes[0].legend(loc="upper right")
        axes[-1].set_xlabel("t in s")

    def errors(self) -> np.ndarray:
        """Root mean square of the errors in the second half of runs, in percent of the states' standard deviations."""
        x = np.ma.masked_invalid(self.x)
        error = (x - self.x_hat)[len(x) // 2 :]
        ratio = 100 * np.ma.sqrt((error**2).mean((0, 1))) / x.std((0, 1))  # masked where a state does not move
        return np.asarray(ratio.filled(np.nan))


def draw_losses(ax: Any, result: Result) -> None:
    """Draw the error of each network in training."""
    for name, history in result.losses.items():
        ax.semilogy(*np.array(history).T, label=name)
    artifact = result.artifact
    ax.set(xlabel="batch", ylabel="error", title=f"{artifact.system}, {artifact.training['pipeline']}")
    ax.legend()


def draw_coverage(ax: Any, followed: list[Followed]) -> None:
    """Draw by age how many errors of usual motions lie in regions that should hold 90 % of them."""
    for each in followed:
        steps, nx = each.x.shape[0], each.x.shape[-1]
        inside = np.ma.masked_invalid(each.distances[:, each.runs.usual]) <= chi_square(COVERAGE, nx)
        edges = np.unique(np.geomspace(1, steps, SPANS + 1).round().astype(int) - 1)
        spans = [slice(first, last) for first, last in zip(edges, [*edges[1:-1], steps])]
        ages = [(span.start + span.stop + 1) / 2 * each.dt for span in spans]
        shares = [100 * inside[span].mean() for span in spans]
        ax.semilogx(ages, shares, ".-", label=f"measurement noise {show_level(each.level)}")
    ax.axhline(100 * COVERAGE, color=TRUTH, lw=0.8)
    ax.set(xlabel="seconds since reset", ylabel="%", ylim=(0, 102), title="errors in regions of 90 %")
    ax.legend(loc="lower right")


def draw_residual(ax: Any, artifact: Artifact, system: System) -> None:
    """Draw the size of the PDE's residual over the plane of the phase portrait, other states at the centre of X."""
    from matplotlib.colors import LogNorm

    first, second = (i % system.nx for i in system.portrait)
    x = np.tile(np.mean(system.X, axis=1), (POINTS**2, 1))
    grids = [np.linspace(*system.X[i], POINTS) for i in (first, second)]
    x[:, first], x[:, second] = (grid.ravel() for grid in np.meshgrid(*grids))
    size = np.linalg.norm(residual(artifact, system, x), axis=1).reshape(POINTS, POINTS)
    image = ax.pcolormesh(*grids, size, norm=LogNorm() if size.all() else None, shading="auto")
    ax.figure.colorbar(image, ax=ax, label="|∂T/∂x f − A T − B h|")
    ax.set(xlabel=system.state_names[first], ylabel=system.state_names[second])
    ax.grid(visible=False)
    ax.set_title("PDE residual over X" if system.nx == 2 else "PDE residual through the centre of X")
