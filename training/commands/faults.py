"""``kkl-gym faults``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from kkl_gym import SYSTEMS, get_system
from observers import Artifact
from observers.artifact import resolve
from observers.storage import write
from training.evaluation.faults import FAULTS, simulate_faults
from training.systems import PROFILES


@dataclass(frozen=True)
class Faults:
    """Give the sensors of the four systems faults, and see how soon the default observers' monitors notice.

    Half of the runs are under random inputs; all have process noise. From the middle of each the sensor is biased by a
    fifth of the output's range, or dead (y = 0), or frozen at its last value. Writes faults.csv, a row for each run and
    fault, table.md and roc.png, in which the threshold of the score varies.
    """

    systems: tuple[str, ...] = tuple(SYSTEMS)
    """Shipped systems."""
    runs: int = 500
    """Number of runs of each system."""
    duration: float = 50.0
    """Their length in seconds."""
    measurement_noise: float = 0.5
    """Standard deviation of the noise on each sample of y."""
    seed: int = 0
    """Of everything random."""
    out: Path = Path("faults")
    """Folder for what is written."""

    def run(self, console: Console) -> pd.DataFrame:
        """Simulate and report."""
        if self.runs < 2 or self.seed < 0:
            raise ValueError(f"need at least 2 runs and a seed that is not negative, got {self.runs}, {self.seed}")
        frames = []
        for name in self.systems:
            if name not in SYSTEMS:
                raise ValueError(f"unknown system {name!r}; there are {', '.join(SYSTEMS)}")
            with console.status(f"breaking the sensor of {name}"):
                artifact = Artifact.read(resolve(name))
                frames.append(
                    simulate_faults(
                        artifact,
                        get_system(name),
                        runs=self.runs,
                        duration=self.duration,
                        measurement_noise=self.measurement_noise,
                        seed=self.seed,
                    )
                )
        found = pd.concat(frames, ignore_index=True)
        write(self.out / "faults.csv", found.to_csv(index=False, float_format="%.6g"))
        console.print(report(self.out))
        console.print(f"wrote faults.csv, table.md and roc.png in {self.out}")
        return found


def report(out: Path) -> Table:
    """Table and figure from faults.csv alone."""
    found = pd.read_csv(out / "faults.csv")
    shown = Table("system", "false alarms", "fault", "noticed in time", "delay in s: median", "95 %")
    lines = [
        "| | false alarms | fault | within | noticed in time | median delay in s | 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for system, group in found.groupby("system", sort=False):
        deadline = PROFILES[str(system)].fault_deadline
        false = f"{100 * (group[group.fault == 'none'].score > 1).mean():.1f} %"
        for fault, runs in group[group.fault != "none"].groupby("fault", sort=False):
            low, high = np.quantile(runs.delay, [0.5, 0.95], method="higher")
            cells = (f"{100 * (runs.score > 1).mean():.1f} %", f"{low:.2f}", f"{high:.2f}")
            shown.add_row(str(system), false, str(fault), *cells)
            lines.append(f"| {system} | {false} | {fault} | {deadline:g} s | {' | '.join(cells)} |")
    duffing = found[(found.system == "reverse_duffing") & (found.fault != "none")]
    if len(duffing):
        lines += ["", "Reverse Duffing by amplitude of the output, noticed in time:", "", *_by_amplitude(duffing)]
    write(out / "table.md", "\n".join(lines) + "\n")
    _draw(out / "roc.png", found)
    return shown


def _by_amplitude(duffing: pd.DataFrame) -> list[str]:
    edges = np.quantile(duffing.amplitude, [0.0, 0.25, 0.5, 0.75, 1.0])
    quarter = pd.cut(duffing.amplitude, edges, include_lowest=True, labels=False)
    names = [f"{low:.1f} to {high:.1f}" for low, high in zip(edges, edges[1:])]  # noqa: RUF007
    lines = ["| fault | " + " | ".join(names) + " |", "|---" * 5 + "|"]
    for fault, runs in duffing.groupby("fault", sort=False):
        shares = [f"{100 * (runs[quarter[runs.index] == i].score > 1).mean():.0f} %" for i in range(4)]
        lines.append(f"| {fault} | " + " | ".join(shares) + " |")
    return lines


def _draw(path: Path, found: pd.DataFrame) -> None:
    from matplotlib.figure import Figure

    systems = list(found.system.unique())
    figure = Figure(figsize=(3.3 * len(systems), 3.4), layout="constrained")
    axes: Any = figure.subplots(1, len(systems), sharey=True, squeeze=False)[0]
    for ax, system in zip(axes, systems, strict=True):
        group = found[found.system == system]
        sound = np.sort(group[group.fault == "none"].score)
        thresholds = np.concatenate([sound, [np.inf]])
        false = [(sound > threshold).mean() for threshold in thresholds]
        for fault in FAULTS[1:]:
            scores = group[group.fault == fault].score.to_numpy()
            ax.plot(false, [(scores > threshold).mean() for threshold in thresholds], label=fault)
            at_one = (sound > 1).mean(), (scores > 1).mean()
            ax.plot(*at_one, "ko", markersize=4, label="score 1" if fault == FAULTS[-1] else None)
        ax.set(
            title=f"{system.replace('_', ' ')}, {PROFILES[system].fault_deadline:g} s",
            xlabel="false alarms, share of runs",
        )
        ax.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes[0].set_ylabel("faults noticed in time")
    axes[-1].legend(loc="lower right")
    figure.savefig(path, dpi=110)
