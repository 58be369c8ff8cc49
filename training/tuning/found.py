"""What tuning found for a system: as a table, as files and as a figure."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.table import Table

from kkl_gym.system import System
from observers.storage import write
from training.evaluation.levels import Level, as_cell, show_level
from training.figures import drawing
from training.tuning.check import settings
from training.tuning.probe import Choice

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXTENDED = "default's real ones and more"


@dataclass(frozen=True)
class Found:
    """What tuning found for a system."""

    system: System
    noise: Level
    fronts: dict[Level, list[Choice]]
    others: list[Choice]
    best: Choice
    least: float | None

    def table(self) -> Table:
        """For people."""
        table = Table(
            "modes", "predicted error in %", "", title=f"{self.system.name}, measurement noise {show_level(self.noise)}"
        )
        for choice in [*self.fronts[self.noise], *self.others]:
            mark = "[green]written[/green]" if choice is self.best else ""
            table.add_row(str(choice.spectrum.modes), f"{choice.error:.3g}", f"{choice.kind} {mark}")
        if self.least is not None:
            table.add_row("–", f"{self.least:.3g}", "who knows the equations and all of y")
        return table

    def save(self, folder: Path, beside: dict[str, Any]) -> None:
        """Write config.json, with some settings beside those that were found, front.csv and front.png."""
        config = {**settings(self.system, self.best.spectrum, self.noise), **beside}
        write(folder / "config.json", json.dumps(config, indent=2) + "\n")
        rows = [
            (as_cell(level), choice.kind, choice.spectrum.modes, choice.error)
            for level, choices in [*self.fronts.items(), (self.noise, self.others)]
            for choice in choices
        ]
        write_csv(folder / "front.csv", ["noise", "kind", "modes", "error"], rows)
        with drawing(folder / "front.png", 11, 4) as figure:
            self.draw(figure)

    def draw(self, figure: "Figure") -> None:
        """Draw predicted errors against numbers of modes, and the eigenvalues that are written."""
        left, right = figure.subplots(1, 2)
        color = f"C{list(self.fronts).index(self.noise)}"
        for i, (level, choices) in enumerate(self.fronts.items()):
            width = 2 if level == self.noise else 1
            left.semilogy(*_points(choices), "o-", color=f"C{i}", ms=3, lw=width, label=f"noise {show_level(level)}")
        for kind, marker in ((EXTENDED, "*"), ("default", "s"), ("paper's", "^"), ("Bessel", "x")):
            same = [choice for choice in self.others if choice.kind == kind]
            if same:
                label = f"{kind}, noise {show_level(self.noise)}"
                left.semilogy(*_points(same), marker, color=color, ms=7, mfc="none", label=label)
        title = self.system.name.replace("_", " ")
        left.set(xlabel="modes for each output", ylabel="predicted error in %", title=title)
        left.set_ylim(top=10 * left.get_ylim()[1])  # room for the legend
        left.legend(ncols=2)
        for choice in self.others:
            if choice.kind == "default":
                poles = choice.spectrum.poles
                right.plot(poles.real, poles.imag, "s", mfc="none", label="default")
        poles = self.best.spectrum.poles
        right.plot(poles.real, poles.imag, "x", color=color, label=f"written: {self.best.kind}")
        right.set(xscale="symlog", xlabel="Re λ in 1/s", ylabel="Im λ in rad/s")
        right.set_title(f"eigenvalues of A, noise {show_level(self.noise)}")
        right.legend()


def _points(choices: list[Choice]) -> np.ndarray:
    return np.array([[choice.spectrum.modes, choice.error] for choice in choices]).T


def write_csv(path: Path, columns: list[str], rows: list[tuple[Any, ...]]) -> None:
    """Write rows under the names of their columns."""
    write(path, pd.DataFrame(rows, columns=columns).to_csv(index=False, float_format="%.6g"))
