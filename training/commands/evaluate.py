"""``kkl-gym evaluate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from observers import Artifact
from observers.storage import write
from training.commands.options import Observers, OwnPolicy, OwnSystem, read_observers, read_policy
from training.evaluation.errors import Domain, errors, unseen_trajectories


@dataclass(frozen=True)
class Evaluate:
    """Print observers' errors on unseen trajectories: in X and in 2X without X, with and without noise.

    SMAPE in percent, median and interquartile range over the trajectories, over all steps (the paper's measure) and
    after the transient: the first fifth of a run, or 5 s where it is driven by random steps and sines. Observers are
    told the levels of noise if they can use them. Trajectories that leave the system's declared bounds are counted, and
    left out. The column "driven" is there for observers that take inputs, "process noise" where there is any; the CSV
    file always has both. Under a policy, those are driven in which it errs about the state and explores.
    """

    observers: Observers
    """Shipped maps, or .safetensors files."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    measurement_noise: Annotated[tuple[float, ...], tyro.conf.arg(aliases=["--noise"])] = (0.0, 0.5)
    """Standard deviations of the noise on each sample of y, one table row for each."""
    process_noise: float = 0.0
    """Level of the process noise, in multiples of the system's scale per second; the environments' default is 0.05."""
    trajectories: int = 100
    """Number of trajectories from each domain."""
    duration: float = 50.0
    """Length of each trajectory in seconds."""
    seed: int = 0
    """Seed of the trajectories and the noise; no seed gives any that training draws."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """File to which the errors of each trajectory are written as well."""

    def run(self, console: Console) -> pd.DataFrame:
        """Evaluate.

        Parameters
        ----------
        console : Console
            Where the tables are printed.

        Returns
        -------
        DataFrame
            The rows of the CSV file, one for each observer, case and trajectory.

        Raises
        ------
        ValueError
            If an observer cannot be had, or a number makes no sense.
        """
        if not self.measurement_noise:
            raise ValueError("give at least one level of measurement noise; 0 is none")
        if self.csv is not None and (self.csv.is_dir() or not self.csv.name):
            raise ValueError(f"csv = {self.csv} is a folder: name a file")
        frames = []
        for name, artifact, system in read_observers(self.observers, self.system):
            with console.status(f"evaluating {name}"):
                frames.append(self._evaluate(name, artifact, system, console))
        found = pd.concat(frames, ignore_index=True)
        if self.csv:
            write(self.csv, found.to_csv(index=False, float_format="%.6g"))
            console.print(f"wrote {self.csv}")
        return found

    def _evaluate(self, name: str, artifact: Artifact, system: System, console: Console) -> pd.DataFrame:
        policy = read_policy(artifact, system, self.policy)
        cases: list[tuple[str, Domain, bool]] = [("X", "X", False), ("2X \\ X", "2X", False)]
        if artifact.nu:
            cases.append(("X", "X", True))
        table = Table(title=f"{name}: SMAPE in %, median (IQR) of {self.trajectories} runs of {self.duration:g} s")
        table.add_column("starts")
        if artifact.nu:
            table.add_column("driven")
        process = [f"{self.process_noise:g}"] if self.process_noise else []
        if process:
            table.add_column("process\nnoise", justify="right")
        for column in ("noise\non y", "all steps", "after transient", "escaped"):
            table.add_column(column, justify="right")
        frames = []
        for starts, domain, driven in cases:
            trajectories = unseen_trajectories(
                system,
                artifact.filter.dt,
                n=self.trajectories,
                duration=self.duration,
                seed=self.seed,
                domain=domain,
                driven=driven,
                process_noise=self.process_noise,
                policy=policy,
            )
            for level in self.measurement_noise:
                found = errors(
                    artifact,
                    system,
                    trajectories,
                    measurement_noise=level,
                    seed=self.seed,
                    skip=min(5.0, self.duration / 2) if driven else None,
                )
                case = [starts, *(["yes" if driven else "no"] if artifact.nu else []), *process, f"{level:g}"]
                table.add_row(*case, spread(found.full), spread(found.late), str(found.escaped))
                columns = {
                    "observer": name,
                    "starts": starts,
                    "driven": driven,
                    "process_noise": self.process_noise,
                    "measurement_noise": level,
                    "trajectory": np.arange(len(found.full)),
                    "smape": found.full,
                    "smape_late": found.late,
                }
                frames.append(pd.DataFrame(columns))
        console.print(table)
        return pd.concat(frames, ignore_index=True)


def spread(values: np.ndarray) -> str:
    """Median and interquartile range as text."""
    if not len(values):
        return "–"
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{median:.2f} ({low:.2f} – {high:.2f})"
