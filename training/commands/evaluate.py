"""``kkl-gym evaluate``."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from kkl_gym.systems import system_of
from observers import Artifact, shipped
from observers.artifact import resolve
from training.evaluation.errors import Domain, errors, unseen_trajectories


@dataclass(frozen=True)
class Evaluate:
    """Print observers' errors on unseen trajectories: in X and in 2X without X, with and without noise.

    SMAPE in percent, median and interquartile range over the trajectories, over all steps (the paper's measure) and
    after the transient: the first fifth of a run, or 5 s where it is driven by random steps and sines. Observers are
    told the levels of noise if they can use them. Trajectories that leave the system's declared bounds are counted, and
    left out.
    """

    observers: tyro.conf.Positional[tuple[str, ...]]
    """Shipped maps, or .safetensors files."""
    system: str | None = None
    """For files of your own system: its class, as script.py:Class or module:Class."""
    noise: tuple[float, ...] = (0.0, 0.5)
    """Standard deviations of the measurement noise."""
    process_noise: float = 0.0
    """Level of the process noise, in multiples of the system's scale per second; the environments' default is 0.05."""
    trajectories: int = 100
    """Number of trajectories from each domain."""
    duration: float = 50.0
    """Their length in seconds."""
    seed: int = 0
    """Of the trajectories and the noise; never one that training draws."""
    csv: Path | None = None
    """Write the error of each trajectory to this file as well."""

    def run(self, console: Console) -> list[str]:
        """Evaluate; returns the lines of the CSV file."""
        if not self.observers:
            raise ValueError(f"name an observer; shipped: {', '.join(shipped()) or 'none'}")
        lines = ["observer,starts,noise,trajectory,smape,smape_late"]
        for name in self.observers:
            artifact = Artifact.read(resolve(name))
            lines += self._evaluate(name, artifact, system_of(artifact, self.system), console)
        if self.csv:
            self.csv.parent.mkdir(parents=True, exist_ok=True)
            self.csv.write_text("\n".join(lines) + "\n")
            console.print(f"wrote {self.csv}")
        return lines

    def _evaluate(self, name: str, artifact: Artifact, system: System, console: Console) -> list[str]:
        suffix = f", process noise {self.process_noise:g}" if self.process_noise else ""
        cases: list[tuple[str, Domain, bool]] = [("X", "X", False), ("2X \\ X", "2X", False)]
        if artifact.nu:
            cases.append(("X, driven", "X", True))
        table = Table(
            title=f"{name}: SMAPE in %, median (IQR) of {self.trajectories} runs of {self.duration:g} s{suffix}"
        )
        table.add_column("starts")
        for column in ("noise", "all steps", "after transient", "escaped"):
            table.add_column(column, justify="right")
        lines = []
        with console.status(f"evaluating {name}"):
            for label, domain, driven in cases:
                runs = unseen_trajectories(
                    system,
                    artifact.filter.dt,
                    n=self.trajectories,
                    duration=self.duration,
                    seed=self.seed,
                    domain=domain,
                    driven=driven,
                    process_noise=self.process_noise,
                )
                for level in self.noise:
                    found = errors(
                        artifact,
                        system,
                        runs,
                        measurement_noise=level,
                        seed=self.seed,
                        skip=min(5.0, self.duration / 2) if driven else None,
                    )
                    table.add_row(label, f"{level:g}", spread(found.full), spread(found.late), str(found.escaped))
                    lines += [
                        f'{name},"{label}{suffix}",{level:g},{i},{full:.6g},{late:.6g}'
                        for i, (full, late) in enumerate(zip(found.full, found.late))
                    ]
        console.print(table)
        return lines


def spread(values: np.ndarray) -> str:
    """Median and interquartile range as text."""
    if not len(values):
        return "–"
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{median:.2f} ({low:.2f} – {high:.2f})"
