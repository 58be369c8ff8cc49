"""What was found as a table, as a file and as a figure."""

from pathlib import Path

import numpy as np
import pandas as pd
from rich.table import Column, Table

from observers.storage import write
from training.checking.finding import percent
from training.evaluation.levels import Level, as_cell, show_level
from training.figures import TRUTH, drawing
from training.neighbours import RESOLUTION
from training.observable.found import Observability

COLOURS = {"determined": "green", "up": "cyan", "partly": "yellow", "not": "bold red", "never": "bold red"}
LEAST_SHOWN = 1e-4  # in the figure


def table(found: Observability, title: str) -> Table:
    """What is said of each hidden signal, for people."""
    given = " and ".join(", ".join(names) for names in (found.measured, found.inputs) if names)
    out = Table(
        "signal",
        "from",
        Column("verdict", no_wrap=True),
        *map(_column, found.noise),
        "linear",
        title=f"{title}\nwhat follows from {given}",
        caption="rms error that is left, in standard deviations of the signal; a constant leaves 100 %; linear: what a "
        "regression on z leaves without noise",
    )
    equations = [i for i in range(1, len(found.noise)) if found.least is not None]
    for i in equations:
        out.add_column(f"equations, {_column(found.noise[i])}")
    for row, judged in enumerate(found.judgements):
        least = [] if found.least is None else [_percent(found.least[i, row]) for i in equations]
        colour = COLOURS[judged.verdict.split()[0]]
        out.add_row(
            judged.signal,
            _window(judged.window, found.dt),
            f"[{colour}]{judged.verdict}[/{colour}]",
            *map(_percent, judged.errors),
            _percent(judged.linear),
            *least,
        )
    return out


def _column(level: Level) -> str:
    return f"noise {show_level(level)}" if np.any(level) else "no noise"


def _window(window: int | None, dt: float) -> str:
    if window is None:
        return "–"
    return "y alone" if window == 0 else f"{window} step{'s' * (window > 1)} ({window * dt:.3g} s)"


def _percent(share: float) -> str:
    if np.isnan(share):
        return "–"
    return percent(share) if share >= RESOLUTION else f"< {percent(RESOLUTION)}"


def save(found: Observability, folder: Path, title: str) -> None:
    """Write observability.csv and observability.png."""
    rows = [
        (name, as_cell(level), window, window * found.dt, found.errors[k, m, i])
        + ((found.linear[m, i], found.changes[m, i]) if k == 0 else (np.nan, np.nan))
        for i, name in enumerate(found.hidden)
        for k, level in enumerate(found.noise)
        for m, window in enumerate(found.windows)
    ]
    columns = ["signal", "measurement_noise", "steps", "seconds", "error", "linear", "change"]
    write(folder / "observability.csv", pd.DataFrame(rows, columns=columns).to_csv(index=False, float_format="%.6g"))
    _draw(found, folder / "observability.png", title)


def _draw(found: Observability, path: Path, title: str) -> None:
    """Errors against windows, a plot for each signal."""
    n = len(found.hidden)
    columns = min(n, 3)
    with drawing(path, 4.5 * columns + 0.5, 3.5 * -(-n // columns)) as figure:
        figure.suptitle(title)
        axes = figure.subplots(-(-n // columns), columns, squeeze=False, sharey=True).ravel()
        for i, ax in enumerate(axes):
            ax.set_visible(i < n)
        for i, (ax, judged) in enumerate(zip(axes, found.judgements)):
            for level, errors in zip(found.noise, found.errors):
                ax.plot(found.windows, 100 * np.maximum(errors[:, i], LEAST_SHOWN), "o-", label=_column(level))
            for errors, look, label in ((found.linear, ":", "linear"), (found.changes, "--", "its change")):
                shown = 100 * np.maximum(errors[:, i], LEAST_SHOWN)
                ax.plot(found.windows, shown, look, color=TRUTH, label=f"{label}, no noise")
            ax.set_xscale("symlog", linthresh=1)
            ax.set(yscale="log", xlabel="steps back", title=f"{judged.signal}: {judged.verdict}")
        axes[0].set_ylabel("error in % of the standard deviation")
        axes[0].legend()
