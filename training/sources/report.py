"""A training on recorded states in one picture."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from observers import Artifact
from training.figures import ESTIMATE, TRUTH, drawing
from training.recorded.errors import estimates
from training.recorded.fit import Recorded
from training.records import Record, pieces

SHOWN = 3  # records in the picture


def write_recorded_report(path: Path, result: Recorded) -> None:
    """Draw the errors in training, and estimates against the states of records that were held out."""
    artifact = result.artifact
    shown = sorted(
        (piece for piece in pieces(result.held_out) if piece.x is not None), key=lambda piece: -piece.duration
    )
    shown = shown[:SHOWN]
    columns = max(1, len(shown))
    with drawing(path, 5 * columns + 1, 2.6 + 1.6 * artifact.nx) as figure:
        grid = figure.add_gridspec(1 + artifact.nx, columns, height_ratios=[1.6, *[1.0] * artifact.nx])
        training = figure.add_subplot(grid[0, :])
        for name, history in result.losses.items():
            training.semilogy(*np.array(history).T, label=name)
        training.set(xlabel="batch", ylabel="error", title=f"{artifact.system}, from recorded states")
        training.legend()
        for column, piece in enumerate(shown):
            draw_estimates(figure, grid, column, artifact, piece, result.errors.relative)


def draw_estimates(
    figure: Any, grid: Any, column: int, artifact: Artifact, piece: Record, relative: Mapping[str, float]
) -> None:
    """Draw the states of a record and their estimates into a column of a figure's grid, below its first row."""
    x_hat, t = estimates(artifact, piece), piece.t - piece.t[0]
    assert piece.x is not None
    for i, (name, error) in enumerate(relative.items()):
        ax = figure.add_subplot(grid[1 + i, column])
        ax.plot(t, piece.x[:, i], color=TRUTH, lw=1.8, label="recorded")
        ax.plot(t, x_hat[:, i], "--", color=ESTIMATE, label="estimated")
        if column == 0:
            ax.set_ylabel(name)
            ax.set_title(f"rms error {error:.2g} of the standard deviation", loc="right")
        if i == 0:
            ax.set_title(Path(piece.name).name, loc="left")
            ax.legend(loc="upper right")
    ax.set_xlabel("t in s")
