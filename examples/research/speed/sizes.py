"""``python -m examples.research sizes``."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from examples.research.speed.observers import in_turns, observer_tasks
from kkl_gym import System, get_system
from observers import Artifact
from training.commands.options import NoiseLevel, SystemName
from training.config import read_changes
from training.evaluation.levels import level_for
from training.figures import ESTIMATE, TRUTH, drawing
from training.files import locked, write
from training.presets import preset
from training.progress import LOG, ProgressBars, progress_bars

if TYPE_CHECKING:
    import pandas as pd

TURNS, STEPS, BATCH_STEPS = 7, 1000, 100  # of each observer that is timed


@dataclass(frozen=True)
class Sizes:
    """Train a T_inv of several sizes for a system, and show errors against the time of a step.

    The widths are those of hidden layers; all else is as `kkl-gym train SYSTEM --size large` has it. Errors are medians
    over unseen motions from X, over all steps. Times are CPU time of one thread: run it with OMP_NUM_THREADS=1, on an
    idle machine. Observers that are there already are not trained again, so that times can be taken again.

    Writes OUT/NAME-WIDTH.safetensors, OUT/sizes.csv and OUT/sizes.png.
    """

    system: SystemName
    widths: tuple[int, ...] = (16, 24, 40, 64, 128, 256)
    """Neurons in each hidden layer."""
    config: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: no file)")] = None
    """JSON file of settings that differ from the preset's."""
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise on each sample of y, for errors under noise."""
    trajectories: int = 100
    """Number of motions for errors."""
    num_envs: int = 1024
    """Rows of the batch that is timed."""
    seed: int = 0
    """Seed of the motions and the noise."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/sizes/NAME)")] = None
    """Folder of results."""

    def run(self, console: Console) -> "pd.DataFrame":
        """Train, measure and draw."""
        import pandas as pd  # which, as torch, takes a second or more that help need not wait for

        if not self.widths or min(self.widths) < 1 or len({*self.widths}) < len(self.widths):
            raise ValueError(f"widths must be positive and differ, got {self.widths}")
        for name in ("trajectories", "num_envs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"the seed must not be negative, got {self.seed}")
        system = get_system(self.system)
        out = self.out or Path("runs/sizes") / system.name
        changes = read_changes(self.config) if self.config else {}
        with locked(out), progress_bars(console, out / LOG) as progress:
            artifacts = {
                width: self._trained(system, {**changes, "width": width}, out, progress) for width in self.widths
            }
            rows = self._measured(artifacts, system, progress)
        frame = pd.DataFrame(rows)
        write(out / "sizes.csv", frame.to_csv(index=False, float_format="%.6g"))
        draw(out / "sizes.png", frame)
        table = Table(title=system.name)
        for column in frame.columns[1:]:
            table.add_column(column.replace("_", " "), justify="right")
        for row in frame.drop(columns="system").itertuples(index=False):
            table.add_row(*(f"{value:,}" if isinstance(value, int) else f"{value:.3g}" for value in row))
        console.print(table)
        console.print(f"wrote sizes.csv, sizes.png and {len(artifacts)} observers in {out}")
        return frame

    def _trained(self, system: System, changes: Mapping[str, Any], out: Path, progress: ProgressBars) -> Artifact:
        """Train an observer, or read an earlier training of the same."""
        from training.lessons import train

        config = preset(system, size="large", changes={"tracking": False, **changes})
        progress.say(f"an observer for {system.name} with hidden layers of {config.width}")
        artifact = train(system, config, out / f"{config.width}", resume=True, console=progress).artifact
        artifact.save(out / f"{system.name}-{config.width}.safetensors")
        return artifact

    def _measured(
        self, artifacts: Mapping[int, Artifact], system: System, progress: ProgressBars
    ) -> list[dict[str, Any]]:
        """Median errors without and under noise and median times of a step, a row for each width."""
        from training.evaluation.errors import errors, unseen_trajectories

        n, dt = self.trajectories, next(iter(artifacts.values())).filter.dt
        motions = unseen_trajectories(system, dt, n=n, duration=system.duration, seed=self.seed)
        rows, tasks = list[dict[str, Any]](), {}
        with progress.phase("estimating", len(artifacts)) as report:
            for done, (width, artifact) in enumerate(artifacts.items(), 1):
                weights = sum(weight.size for weight in artifact.inverse.mlp.weights)
                row = {"system": system.name, "width": width, "weights": weights}
                levels = {"without": 0.0, "under": level_for(artifact, system, self.measurement_noise)}
                for name, level in levels.items():
                    smape = errors(artifact, system, motions, measurement_noise=level, seed=self.seed).full
                    row[f"smape_{name}_noise"] = float(np.median(smape))
                rows.append(row)
                tasks[width, "us_single"] = observer_tasks(artifact, system, rows=None, steps=STEPS)["KKL"]
                batch = observer_tasks(artifact, system, rows=self.num_envs, steps=BATCH_STEPS)
                tasks[width, "us_a_row"] = batch["KKL"]
                report(done)
        with progress.phase("timing", len(tasks) * (TURNS + 1)) as report:
            seconds = in_turns(tasks, TURNS, report)
        for row, width in zip(rows, artifacts, strict=True):
            for name, n in (("us_single", 1), ("us_a_row", self.num_envs)):
                row[name] = 1e6 * float(np.median(seconds[width, name])) / n
        return rows


def draw(path: Path, *frames: "pd.DataFrame") -> None:
    """Errors of all sizes against the time of a step."""
    from matplotlib.ticker import LogLocator

    with drawing(path, 3.6 * len(frames), 3.4) as figure:
        axes: Any = figure.subplots(1, len(frames), squeeze=False)[0]
        for ax, frame in zip(axes, frames, strict=True):
            curves = {"smape_under_noise": ("under noise", ESTIMATE), "smape_without_noise": ("without noise", TRUTH)}
            for column, (label, color) in curves.items():
                ax.plot(frame.us_a_row, frame[column], "o-", color=color, label=label)
            for row in frame.itertuples():
                at = (row.us_a_row, row.smape_under_noise)
                ax.annotate(f"{row.width}", at, xytext=(0, 5), textcoords="offset points", fontsize="small")
            ax.set(xscale="log", yscale="log", title=frame.system.iloc[0].replace("_", " "))
            ax.set_xlabel("µs for each row of a batch")
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.set_major_formatter("{x:g}")
                axis.set_minor_formatter("")
        axes[0].set_ylabel("median SMAPE in %")
        axes[0].legend()
