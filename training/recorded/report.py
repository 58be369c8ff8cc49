"""How good an observer is on recorded states that it was not trained on: a table and a picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from observers import Artifact, KKLObserver
from observers.storage import replacing
from training.maps.coordinates import settling_time
from training.records import Record, pieces

SHOWN = 3  # records in the picture


@dataclass(frozen=True)
class RecordedErrors:
    """Errors on recorded states, relative to their standard deviations.

    Parameters
    ----------
    relative : dict of str to float
        For each hidden signal, the root mean square error over the signal's standard deviation, all samples together.
    after : float
        Seconds after the start of a record, or of a gap, that were left out.
    seconds : float
        Length of what was compared.
    """

    relative: dict[str, float]
    after: float
    seconds: float


def recorded_errors(artifact: Artifact, records: Sequence[Record], after: float | None = None) -> RecordedErrors:
    """Run an observer along records and compare its estimates with the recorded states.

    Parameters
    ----------
    artifact : Artifact
        An observer from recorded states.
    records : sequence of Record
        With states, on the observer's grid (:func:`training.records.resampled`); filters begin anew after gaps.
    after : float, optional
        Seconds for which each transient is left out; by default until the filter has forgotten its start to one part
        in a thousand.

    Returns
    -------
    RecordedErrors
        NaN where nothing is left to compare.
    """
    after = settling_time(artifact.filter) if after is None else after
    first = int(np.ceil(after / artifact.filter.dt))
    apart, x = [np.zeros((0, artifact.nx))], [np.zeros((0, artifact.nx))]
    for record in pieces(records):
        if record.x is not None:
            apart.append((estimates(artifact, record) - record.x)[first:])
            x.append(record.x[first:])
    error, truth = np.concatenate(apart), np.concatenate(x)
    known = ~np.isnan(error).any(-1)
    error, truth = error[known], truth[known]
    names = (artifact.signals or {})["hidden"]
    if not len(error):
        return RecordedErrors(dict.fromkeys(names, float("nan")), after, 0.0)
    relative = np.sqrt(np.mean(error**2, 0)) / np.where(truth.std(0) > 0, truth.std(0), np.nan)
    return RecordedErrors(dict(zip(names, relative.tolist())), after, len(error) * artifact.filter.dt)


def estimates(artifact: Artifact, record: Record) -> np.ndarray:
    """An observer's estimates along a record without gaps on its grid, (n, nx)."""
    return KKLObserver(artifact).estimate(record.y, record.u if artifact.nu else None)


def write_recorded_report(
    path: Path, artifact: Artifact, losses: Mapping[str, Sequence[tuple[int, float]]], held_out: Sequence[Record]
) -> RecordedErrors:
    """Draw the errors in training, and estimates against the states of records that were held out.

    Parameters
    ----------
    path : Path
        Of the figure.
    artifact : Artifact
        The observer.
    losses : mapping of str to sequence of (int, float)
        Of each network.
    held_out : sequence of Record
        On the observer's grid; there may be none.

    Returns
    -------
    RecordedErrors
        What stands in the figure.
    """
    from matplotlib.figure import Figure

    found = recorded_errors(artifact, held_out)
    shown = sorted((piece for piece in pieces(held_out) if piece.x is not None), key=lambda piece: -piece.duration)
    shown = shown[:SHOWN]
    columns = max(1, len(shown))
    figure = Figure(figsize=(5 * columns + 1, 2.6 + 1.6 * artifact.nx), layout="constrained")
    grid = figure.add_gridspec(1 + artifact.nx, columns, height_ratios=[1.6, *[1.0] * artifact.nx])
    training = figure.add_subplot(grid[0, :])
    for name, history in losses.items():
        training.semilogy(*np.array(history).T, label=name)
    training.set(xlabel="batch", ylabel="error", title=f"{artifact.system}, from recorded states")
    training.legend()
    for column, piece in enumerate(shown):
        draw_estimates(figure, grid, column, artifact, piece, found.relative)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
    return found


def draw_estimates(
    figure: Any, grid: Any, column: int, artifact: Artifact, piece: Record, relative: Mapping[str, float]
) -> None:
    """Draw the states of a record and their estimates into a column of a figure's grid, below its first row."""
    x_hat, t = estimates(artifact, piece), piece.t - piece.t[0]
    assert piece.x is not None
    for i, (name, error) in enumerate(relative.items()):
        ax = figure.add_subplot(grid[1 + i, column])
        ax.plot(t, piece.x[:, i], "k", lw=1.2, label="recorded")
        ax.plot(t, x_hat[:, i], "m--", lw=1.2, label="estimated")
        if column == 0:
            ax.set_ylabel(name)
            ax.set_title(f"rms error {error:.2g} of the standard deviation", loc="right", fontsize="medium")
        if i == 0:
            ax.set_title(Path(piece.name).name, loc="left", fontsize="medium")
            ax.legend(loc="upper right")
    ax.set_xlabel("t in s")
