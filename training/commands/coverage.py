"""The table of ``kkl-gym evaluate --calibration``: coverage of error bars."""

from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from kkl_gym.system import System
from observers import Artifact
from training.evaluation.coverage import REGIONS, Coverage, coverage
from training.evaluation.errors import UnseenTrajectories
from training.evaluation.levels import Level, as_cell, show_level

if TYPE_CHECKING:
    import pandas as pd

# Seconds at the pace of the shipped systems: spans are the first ones, and all after the last.
FIRST, SETTLED = 2.0, 5.0
SHARES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)  # levels of noise, in multiples of the map's largest


def default_levels(artifact: Artifact) -> list[Level]:
    """Levels of noise at which error bars are judged."""
    largest = np.asarray(artifact.inverse.measurement_noise_max)
    return [float(level) if level.ndim == 0 else tuple(level.tolist()) for level in (s * largest for s in SHARES)]


def judged(
    artifact: Artifact, system: System, trajectories: UnseenTrajectories, *, level: Level, seed: int, ekf: bool
) -> list[dict[str, Any]]:
    """Judge error bars, and a Kalman filter's covariance beside them, on trajectories."""
    dt, steps = artifact.filter.dt, len(trajectories.x)
    first, settled = (round(seconds * system.pace / dt) for seconds in (FIRST, SETTLED))
    spans = {
        f"first {first * dt:g} s": slice(0, first),
        f"after {settled * dt:g} s": slice(min(settled, steps - 1), None),
    }
    how: dict[str, Any] = {"measurement_noise": level, "seed": seed, "spans": tuple(spans.values())}
    found = {"KKL": coverage(artifact, system, trajectories, **how)}
    if ekf:
        found["EKF"] = coverage(None, system, trajectories, **how)
    return [
        {"observer": who, "span": span, "measurement_noise": as_cell(level), **_cells(one, system)}
        for who, each in found.items()
        for span, one in zip(spans, each, strict=True)
    ]


def _cells(found: Coverage, system: System) -> dict[str, float]:
    cells = {}
    for i, region in enumerate(REGIONS):
        cells[f"{100 * region:g}"] = 100 * found.joint[i]
        for name, value in zip(system.state_names, found.states[i], strict=True):
            cells[f"{100 * region:g} {name}"] = 100 * value
    low, high = found.limits
    return {**cells, "nees": found.nees, "nees_low": low, "nees_high": high}


def coverage_table(title: str, rows: "pd.DataFrame") -> Table:
    """Show rows of :func:`judged`."""
    regions = [f"{100 * region:g}" for region in REGIONS]
    limits = f"{rows.nees_low.min():.2f} to {rows.nees_high.max():.2f}"
    shown = Table(title=title, caption=f"NEES lies from {limits} with probability 95 % where covariances are true")
    columns = ["observer", "starts", "span", "noise", *(f"{region} %" for region in regions), "NEES"]
    for column in columns:
        shown.add_column(column, justify="left" if column in columns[:3] else "right", no_wrap=True)
    for row in rows.to_dict("records"):
        shown.add_row(
            row["observer"],
            f"{row['starts']}{', driven' if row['driven'] else ''}",
            row["span"],
            str(row["measurement_noise"])
            if isinstance(row["measurement_noise"], str)
            else show_level(row["measurement_noise"]),
            *(f"{row[region]:.1f}" for region in regions),
            f"{row['nees']:.2f}",
        )
    return shown
