"""Faulty sensors, and how soon an observer's monitor notices them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from kkl_gym import get_system
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.artifact import resolve
from training.calibration import sound_runs
from training.data import output
from training.files import write

FAULTS_SEED = 6  # first entry of its seeds; those of training, evaluation and calibration are others
Fault = Literal["none", "bias", "drop-out", "freeze"]
FAULTS: tuple[Fault, ...] = get_args(Fault)
BIAS = 0.2  # of the output's range
# Seconds within which a fault should be noticed; for the first two about a period (Duffing's, at amplitude 1).
DEADLINES = {"reverse_duffing": 10.0, "van_der_pol": 8.9, "rossler": 2.0, "lorenz": 2.0}


@dataclass(frozen=True)
class Faults:
    """Give the sensors of the four systems faults, and see how soon the default observers' monitors notice.

    Half of the runs are under random inputs; all have process noise. From the middle of each the sensor is biased by a
    fifth of the output's range, or dead (y = 0), or frozen at its last value. Writes faults.csv, a row for each run and
    fault, table.md and roc.png, in which the threshold of the score varies.
    """

    systems: tuple[str, ...] = tuple(DEADLINES)
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
            if name not in DEADLINES:
                raise ValueError(f"unknown system {name!r}; there are {', '.join(DEADLINES)}")
            with console.status(f"breaking the sensor of {name}"):
                artifact = Artifact.read(resolve(name))
                frames.append(
                    play(artifact, get_system(name), self.runs, self.duration, self.measurement_noise, self.seed)
                )
        found = pd.concat(frames, ignore_index=True)
        write(self.out / "faults.csv", found.to_csv(index=False, float_format="%.6g"))
        console.print(report(self.out))
        console.print(f"wrote faults.csv, table.md and roc.png in {self.out}")
        return found


def play(
    artifact: Artifact, system: System, runs: int, duration: float, measurement_noise: float, seed: int
) -> pd.DataFrame:
    """One row for each run and fault: amplitude, the highest score, and the delay until it exceeded 1.

    ``score`` is the highest of the whole run where nothing is at fault, and within the deadline after the fault
    elsewhere. ``delay`` is in seconds, infinite where the score never exceeds 1 within the run. ``amplitude`` is the
    largest sound |y| after the middle of the run.
    """
    dt, rng = artifact.filter.dt, np.random.default_rng([FAULTS_SEED, seed])
    x, u = sound_runs(artifact, system, runs, duration, rng)
    clean = output(system, x)
    y = clean + measurement_noise * rng.standard_normal(clean.shape)
    undriven = clean[len(clean) // 2 :, ~u.any((0, 2))]
    width = np.ptp(undriven, axis=(0, 1))
    at, within = len(y) // 2, round(DEADLINES[system.name] / dt)
    observer = KKLObserver(artifact, measurement_noise, monitor=True, process_noise=system.process_noise)
    frames = []
    for fault in FAULTS:
        seen = y.copy()
        if fault == "bias":
            seen[at:] += BIAS * width
        elif fault == "drop-out":
            seen[at:] = 0.0
        elif fault == "freeze":
            seen[at:] = seen[at]
        score = _scores(observer, seen, u if artifact.nu else None)
        judged = score if fault == "none" else score[at : at + within]
        late = score if fault == "none" else score[at:]
        alarmed = (late > 1).any(0)
        frames.append(
            pd.DataFrame(
                {
                    "system": system.name,
                    "fault": fault,
                    "run": np.arange(runs),
                    "amplitude": np.abs(clean[at:]).max((0, 2)),
                    "score": judged.max(0),
                    "delay": np.where(alarmed, (late > 1).argmax(0) * dt, np.inf),
                }
            )
        )
    return pd.concat(frames, ignore_index=True)


def report(out: Path) -> Table:
    """Table and figure from faults.csv alone."""
    found = pd.read_csv(out / "faults.csv")
    shown = Table("system", "false alarms", "fault", "noticed in time", "delay in s: median", "95 %")
    lines = [
        "| | false alarms | fault | within | noticed in time | median delay in s | 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for system, group in found.groupby("system", sort=False):
        deadline = DEADLINES[str(system)]
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
        ax.set(title=f"{system.replace('_', ' ')}, {DEADLINES[system]:g} s", xlabel="false alarms, share of runs")
        ax.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes[0].set_ylabel("faults noticed in time")
    axes[-1].legend(loc="lower right")
    figure.savefig(path, dpi=110)


def _scores(observer: KKLObserver, y: np.ndarray, u: np.ndarray | None) -> np.ndarray:
    """The monitor's score at every sample, (steps + 1, n)."""
    observer.reset(y[0])
    out = np.zeros(y.shape[:2])
    for k in range(1, len(y)):
        observer.advance(y[k], None if u is None else u[k - 1])
        out[k] = observer.score
    return out
