"""``kkl-gym faults``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from kkl_gym import SYSTEMS
from observers.storage import require_writable, write
from training import markdown
from training.commands.options import NoiseLevel, Observers, OwnPolicy, OwnSystem, Seconds, read_observers, read_policy
from training.evaluation.levels import beyond, level_for
from training.figures import ALARM, ESTIMATE, MEASURED, RIVAL, TRUTH, drawing
from training.progress import progress_bars

if TYPE_CHECKING:
    import pandas as pd

LEAST, MOST = 0.5, 100.0  # thresholds that are drawn


@dataclass(frozen=True)
class Faults:
    """Give sensors faults, and see how soon observers' monitors notice them.

    Half of the trajectories are under random inputs, if the observer knows inputs; all have process noise. From the
    middle of each the sensor is biased by a fifth of the output's range, or dead (y = 0), or frozen at its last value.
    A fault should be noticed within a time that is chosen for each shipped system, and is a fifth of the duration for
    others. Writes faults.csv, a row for each trajectory and fault, table.md and scores.png, in which the threshold of
    the score varies.
    """

    observers: Observers = tuple(SYSTEMS)
    """Shipped maps, or .safetensors files, with limits for a monitor; by default the newest of each shipped system."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    trajectories: int = 500
    """Number of trajectories for each observer."""
    duration: Seconds = None
    """Length of each trajectory in seconds; 50 for the systems that ship."""
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise on each sample of y, or one for each output as in 0.1,0.3. Maps that were trained
    for less are left out."""
    seed: int = 0
    """Seed of starts, inputs and noise."""
    out: Path = Path("runs/faults")
    """Folder for what is written."""

    def run(self, console: Console) -> "pd.DataFrame":
        """Simulate and report."""
        import pandas as pd  # which takes half a second that help need not wait for

        from training.evaluation.faults import PARTS, simulate_faults

        if self.trajectories < 2 or self.seed < 0:
            raise ValueError(
                f"need at least 2 trajectories and a seed that is not negative, got {self.trajectories}, {self.seed}"
            )
        if len(set(self.observers)) < len(self.observers):
            raise ValueError(f"name each observer once, got {', '.join(self.observers)}")
        frames = []
        require_writable(self.out)
        with progress_bars(console) as progress:
            for name, artifact, system in read_observers(self.observers, self.system):
                level = level_for(artifact, system, self.measurement_noise)
                if reason := beyond(artifact, level):
                    progress.say(f"{name}, left out: {reason}")
                    continue
                with progress.phase(f"breaking the sensor of {name}", PARTS) as report_parts:
                    found = simulate_faults(
                        artifact,
                        system,
                        trajectories=self.trajectories,
                        duration=system.duration if self.duration is None else self.duration,
                        measurement_noise=level,
                        seed=self.seed,
                        policy=read_policy(artifact, system, self.policy),
                        report=report_parts,
                    )
                found.insert(0, "observer", name)
                frames.append(found)
        if not frames:
            raise ValueError(f"nothing is left of {', '.join(self.observers)}: the lines above say why")
        found = pd.concat(frames, ignore_index=True)
        write(self.out / "faults.csv", found.to_csv(index=False, float_format="%.6g"))
        console.print(report(self.out))
        console.print(f"wrote faults.csv, table.md and scores.png in {self.out}")
        return found


def report(out: Path) -> Table:
    """Write table.md and scores.png from faults.csv alone."""
    import pandas as pd

    found = pd.read_csv(out / "faults.csv")
    header = ["false alarms", "fault", "within", "noticed in time", "median delay in s", "95 %"]
    rows = []
    for observer, group in found.groupby("observer", sort=False):
        false = f"{100 * (group[group.fault == 'none'].score > 1).mean():.1f} %"
        for fault, faulty in group[group.fault != "none"].groupby("fault", sort=False):
            noticed = f"{100 * (faulty.score > 1).mean():.1f} %"
            delays = (f"{delay:.2f}" for delay in np.quantile(faulty.delay, [0.5, 0.95], method="higher"))
            rows.append([str(observer), false, str(fault), f"{faulty.deadline.iloc[0]:g} s", noticed, *delays])
    shown = Table(Column("observer", overflow="fold"), *header)
    for row in rows:
        shown.add_row(*row)
    write(out / "table.md", "\n".join(markdown.table(["", *header], rows)) + "\n")
    draw(out / "scores.png", found)
    return shown


def draw(path: Path, found: "pd.DataFrame") -> None:
    """Draw how many runs exceed a threshold of the score in time, as it varies: sound ones and faulty ones."""
    from training.evaluation.faults import FAULTS

    observers = list(found.observer.unique())
    with drawing(path, max(5.0, 2.5 * len(observers)), 3.2) as figure:
        axes: Any = figure.subplots(1, len(observers), sharey=True, squeeze=False)[0]
        for ax, observer in zip(axes, observers, strict=True):
            group = found[found.observer == observer]
            for fault, color in zip(FAULTS, (MEASURED, RIVAL, ALARM, ESTIMATE), strict=True):
                scores = np.sort(group[group.fault == fault].score)
                share = 100 * np.arange(len(scores), 0, -1) / len(scores)
                ax.step(scores, share, where="pre", color=color, label="sound" if fault == "none" else fault)
            ax.axvline(1.0, color=TRUTH, lw=0.8, ls="--", label="where it warns")
            title = f"{Path(observer).stem.replace('_', ' ')}, within {group.deadline.iloc[0]:g} s"
            ax.set(title=title, xlabel="threshold of the score", xscale="log", xlim=(LEAST, MOST), ylim=(-2, 102))
        axes[0].set_ylabel("runs above it, %")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=1 + len(FAULTS))
