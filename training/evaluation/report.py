"""A training in one picture."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.factors import COVERAGE
from training.config import settings_of
from training.evaluation.levels import Level, show_level
from training.figures import ESTIMATE, TRUTH, drawing
from training.lessons.calibrate import chi_square, squared_distance
from training.maps.forward import residual
from training.sources.simulated import SimulatedSource
from training.sources.source import Runs, Source, TooFewRunsError
from training.train_observer import Result

RUNS = 100  # simulated motions
OTHER_SEED = 2**31  # added to that of the training
SAMPLES, SPANS = 240, 24  # ages at which covariances are judged, and how many spans they fall into


def write_report(path: Path, result: Result, source: Source | System) -> None:
    """Draw the errors in training, how true the covariances are, T's PDE residual, and estimates of held-out motions.

    Simulated motions are other ones than those of training and calibration, of the same kinds. Recorded ones are those
    on which covariances were calibrated.
    """
    artifact = result.artifact
    if isinstance(source, System):
        source = SimulatedSource(source, settings_of(artifact.training))
    runs = held_out(source)
    followed = Followed(artifact, runs) if runs else None
    panels: list[Callable[[Any], None]] = [partial(draw_losses, result=result)]
    if followed and artifact.inverse.error_covariance is not None:
        panels.append(followed.draw_coverage)
    if artifact.forward is not None and isinstance(source, SimulatedSource):
        panels.append(partial(draw_residual, artifact=artifact, system=source.system))
    states = artifact.nx if followed else 0
    with drawing(path, 12, 3.2 + 1.5 * states) as figure:
        grid = figure.add_gridspec(1 + states, 6, height_ratios=[2.0, *[1.0] * states])
        width = 6 // len(panels)
        for i, draw in enumerate(panels):
            draw(figure.add_subplot(grid[0, i * width : (i + 1) * width]))
        for column in range(2 if followed else 0):
            assert followed is not None
            axes = [figure.add_subplot(grid[1 + i, 3 * column : 3 * column + 3]) for i in range(states)]
            followed.draw_estimates(axes, column, state_names(source, artifact), recorded=artifact.signals is not None)


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
        return source.system.state_names
    return tuple((artifact.signals or {})["hidden"])


class Followed:
    """An observer's estimates along runs, without measurement noise and at its usual level."""

    def __init__(self, artifact: Artifact, runs: Runs) -> None:
        usual = artifact.measurement_noise
        self.levels: list[Level] = [0.0, usual] if np.any(usual) else [0.0]
        rng = np.random.default_rng(0)
        self.n, self.process_noise, self.dt = runs.x.shape[1], runs.process_noise, artifact.filter.dt
        self.usual = np.flatnonzero(runs.usual)  # covariances are those of motions from X
        self.x = np.concatenate([runs.x] * len(self.levels), axis=1)
        self.x_hat, steps = np.empty_like(self.x), len(runs.x)
        self.ages = np.unique(np.geomspace(1, steps, SAMPLES).round().astype(int)) - 1
        self.distances = np.full((len(self.ages), self.x.shape[1]), np.nan)
        for i, level in enumerate(self.levels):
            y = runs.y + np.asarray(level) * rng.standard_normal(runs.y.shape)
            for noise in np.unique(runs.process_noise):
                rows = np.flatnonzero(runs.process_noise == noise)
                observer = KKLObserver(artifact, level, process_noise=float(noise), compiled=False)
                self._follow(observer, y[:, rows], runs.u[:, rows], i * self.n + rows)

    def _follow(self, observer: KKLObserver, y: np.ndarray, u: np.ndarray, columns: np.ndarray) -> None:
        """Fill in the columns of one observer."""
        slots = {int(age): i for i, age in enumerate(self.ages)}
        judged = observer.artifact.inverse.error_covariance is not None
        for k in range(len(y)):
            x_hat = observer.reset(y[0]) if k == 0 else observer.step(y[k], u[k - 1] if u.shape[-1] else None)
            self.x_hat[k, columns] = x_hat
            if judged and k in slots:
                error = self.x[k, columns] - x_hat
                self.distances[slots[k], columns] = squared_distance(error, observer.covariance)

    def draw_coverage(self, ax: Any) -> None:
        """Draw by age how many errors lie in regions that should hold 90 % of them."""
        edge = chi_square(COVERAGE, self.x.shape[-1])
        distances = np.ma.masked_invalid(self.distances)
        spans = np.array_split(np.arange(len(self.ages)), min(SPANS, len(self.ages)))
        for i, level in enumerate(self.levels):
            columns = i * self.n + self.usual
            shares = [100 * (distances[span][:, columns] <= edge).mean() for span in spans]
            ages = [(self.ages[span].mean() + 1) * self.dt for span in spans]
            ax.semilogx(ages, shares, ".-", label=f"measurement noise {show_level(level)}")
        ax.axhline(100 * COVERAGE, color=TRUTH, lw=0.8)
        ax.set(xlabel="seconds since reset", ylabel="%", ylim=(0, 102), title="errors in regions of 90 %")
        ax.legend(loc="lower right")

    def draw_estimates(self, axes: Sequence[Any], column: int, names: Sequence[str], *, recorded: bool) -> None:
        """Draw the states of a run and their estimates; of simulated runs the second half has process noise."""
        level, run = (self.levels[0], 0) if column == 0 else (self.levels[-1], self.n // 2)
        first = self.levels.index(level) * self.n
        t = np.arange(len(self.x)) * self.dt
        x, x_hat = self.x[:, first + run], self.x_hat[:, first + run]
        x_hat = np.where(np.isnan(x), np.nan, x_hat)  # recorded runs differ in length
        for ax, i, error in zip(axes, range(len(names)), self._errors(slice(first, first + self.n))):
            ax.plot(t, x[:, i], color=TRUTH, lw=1.8, label="true")
            ax.plot(t, x_hat[:, i], "--", color=ESTIMATE, label="estimated")
            ax.set_ylabel(names[i])
            ax.set_title(f"rms error {error:.2g} %", loc="right")
        noise = f"measurement noise {show_level(level)}, process noise {self.process_noise[run]:g}"
        axes[0].set_title("as recorded" if recorded else noise, loc="left")
        axes[0].legend(loc="upper right")
        axes[-1].set_xlabel("t in s")

    def _errors(self, columns: slice) -> np.ndarray:
        """Root mean square of the errors in the second half of runs, in percent of the states' standard deviations."""
        x = np.ma.masked_invalid(self.x)
        error = (x - self.x_hat)[len(x) // 2 :, columns]
        ratio = 100 * np.ma.sqrt((error**2).mean((0, 1))) / x.std((0, 1))  # masked where a state does not move
        return np.asarray(ratio.filled(np.nan))


def draw_losses(ax: Any, result: Result) -> None:
    """Draw the error of each network in training."""
    for name, history in result.losses.items():
        ax.semilogy(*np.array(history).T, label=name)
    artifact = result.artifact
    ax.set(xlabel="batch", ylabel="error", title=f"{artifact.system}, {artifact.training['pipeline']}")
    ax.legend()


def draw_residual(ax: Any, artifact: Artifact, system: System) -> None:
    """Draw the size of the PDE's residual over the plane of the phase portrait, other states at the centre of X."""
    from matplotlib.colors import LogNorm

    points = 150  # along each axis
    first, second = (i % system.nx for i in system.portrait)
    x = np.tile(np.mean(system.X, axis=1), (points**2, 1))
    grids = [np.linspace(*system.X[i], points) for i in (first, second)]
    x[:, first], x[:, second] = (grid.ravel() for grid in np.meshgrid(*grids))
    size = np.linalg.norm(residual(artifact, system, x), axis=1).reshape(points, points)
    image = ax.pcolormesh(*grids, size, norm=LogNorm() if size.all() else None, shading="auto")
    ax.figure.colorbar(image, ax=ax, label="|∂T/∂x f − A T − B h|")
    ax.set(xlabel=system.state_names[first], ylabel=system.state_names[second])
    ax.grid(visible=False)
    ax.set_title("PDE residual over X" if system.nx == 2 else "PDE residual through the centre of X")
