"""What trained agents' scores say together: normalised means of seeds, with intervals."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from training.figures import MEASURED, RIVAL, drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Cell = Mapping[str, Any]
COLUMNS = 3  # of panels in a figure


def normalised(scores: Any, top: Any, idle: float) -> np.ndarray:
    """Scores on a scale on which doing nothing of use has 0."""
    span = np.where(np.asarray(top) > idle, np.asarray(top) - idle, np.nan)
    return np.asarray((scores - idle) / span)


def middle(values: np.ndarray, axis: int = -1) -> Any:
    """Interquartile mean along an axis."""
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def interval(values: np.ndarray, best: np.ndarray, idle: float) -> tuple[float, float, float]:
    """Interquartile mean of the normalised scores of agents, with a bootstrap 95 % interval.

    With five agents the interval covers about nine times in ten, for which bootstrap intervals of so few are known.

    Shapes: ``values`` (n,), ``best`` (m,).
    """

    def statistic(mine: np.ndarray, tops: np.ndarray = best, axis: int = -1) -> np.ndarray:
        return normalised(middle(mine, axis), middle(tops, axis), idle)

    found = float(statistic(values))
    if min(len(values), len(best)) < 3 or np.isnan(found):
        return found, np.nan, np.nan
    samples = (values,) if values is best else (values, best)
    with warnings.catch_warnings():  # where some resamples of the best are no better than zero, there are no ends
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)
        found_in = scipy.stats.bootstrap(samples, statistic, n_resamples=2000, method="percentile", rng=0)
    ends = found_in.confidence_interval
    return found, float(ends.low), float(ends.high)


def draw_scores(path: Path, panels: Mapping[str, Sequence[Cell | None]], labels: Sequence[str], title: str) -> None:
    """Draw the normalised scores of several tasks."""
    columns = min(COLUMNS, max(1, len(panels)))
    rows = -(-len(panels) // columns)
    with drawing(path, 2.6 * columns + 1.5, 2.6 * rows + 0.6) as figure:
        axes = figure.subplots(max(1, rows), columns, sharey=True, squeeze=False).ravel()
        for ax, (task, cells) in zip(axes, panels.items()):
            draw_panel(ax, cells, labels, task)
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        figure.suptitle(title)


def draw_panel(ax: "Axes", cells: Sequence[Cell | None], labels: Sequence[str], title: str) -> None:
    """Draw the normalised scores of one task: agents as dots, their means with intervals."""
    for place, cell in enumerate(cells):
        if cell is not None:
            found, low, high = cell["interval"]
            ax.plot(cell["agents"], np.full(len(cell["agents"]), place), ".", color=MEASURED)
            ax.plot([low, high], [place, place], color=RIVAL, lw=2)
            ax.plot(found, place, "o", color=RIVAL, markersize=6)
    ax.axvline(1.0, color=MEASURED, lw=0.8)
    ax.set(title=title, xlabel="normalised score")
    ax.locator_params(axis="x", nbins=4)
    ax.set_yticks(range(len(labels)), labels)
