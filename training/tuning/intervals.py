"""Choosing the spectrum of a physics-informed map: T must be smooth, and the predicted error small."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from rich.table import Table

from kkl_gym.system import System
from observers.storage import write
from training.evaluation.levels import Level
from training.smoothness import Smoothness, intervals, smoothest, smoothness
from training.spectrum import Spectrum, papers_spectrum
from training.tuning.probe import Choice, Probe

CANDIDATE, PAPERS = "interval", "paper's"


@dataclass(frozen=True)
class Judged:
    """Spectra of real eigenvalues with what is known of them before training."""

    choices: list[Choice]
    smoothness: list[Smoothness]

    @property
    def best(self) -> Choice:
        """The interval of the least predicted error among those for which T is smooth, or comes closest to it."""
        found = [(c, one) for c, one in zip(self.choices, self.smoothness, strict=True) if c.kind == CANDIDATE]
        smooth = [choice for choice, one in found if one.smooth]
        if smooth:
            return min(smooth, key=lambda choice: choice.error)
        return found[smoothest([one for _, one in found])][0]

    def table(self, title: str) -> Table:
        """For people."""
        table = Table("eigenvalues in 1/s", "roughness", "exponent", "T", "predicted error in %", "", title=title)
        best = self.best
        for choice, one in zip(self.choices, self.smoothness, strict=True):
            values = choice.spectrum.eigenvalues
            table.add_row(
                f"{values[0]:.3g} to {values[-1]:.3g}",
                f"{one.roughness.max():.2g}",
                f"{one.exponent.min():.2f}",
                "smooth" if one.smooth else "rough",
                f"{choice.error:.3g}",
                "[green]written[/green]" if choice is best else "paper's" if choice.kind == PAPERS else "",
            )
        return table

    def save(self, folder: Path, dt: float) -> None:
        """Write config.json for ``kkl-gym train --pipeline spinn`` and intervals.csv."""
        config = {"eigenvalues": self.best.spectrum.eigenvalues, "dt": dt}
        write(folder / "config.json", json.dumps(config, indent=2) + "\n")
        rows = [
            {
                "kind": choice.kind,
                "slowest": choice.spectrum.eigenvalues[0],
                "fastest": choice.spectrum.eigenvalues[-1],
                "distance": one.distance,
                "roughness": one.roughness.max(),
                "exponent": one.exponent.min(),
                "error": choice.error,
            }
            for choice, one in zip(self.choices, self.smoothness, strict=True)
        ]
        write(folder / "intervals.csv", pd.DataFrame(rows).to_csv(index=False, float_format="%.6g"))


def judge(
    system: System,
    dt: float,
    *,
    duration: float,
    measurement_noise: Level,
    seed: int = 0,
    report: Callable[[float], object] = lambda share: None,
) -> Judged:
    """Judge the intervals of :mod:`training.smoothness` and the paper's."""
    probe = Probe(system, dt, duration, seed=seed)
    candidates, papers = intervals(system, dt), Spectrum(papers_spectrum(system))
    choices, found = list[Choice](), list[Smoothness]()

    def tell() -> None:
        report((len(choices) + len(found)) / (2 * len(candidates) + 2))

    for one in (*candidates, papers):
        kind = PAPERS if one is papers else CANDIDATE
        choices.append(Choice(one, probe.error(one, measurement_noise), kind))
        tell()
    # The paper's apart: motions are as long as the slowest asks, and the others are to see those of smooth_spectrum.
    for spectra in (candidates, [papers]):
        for judged in smoothness(system, spectra, dt, seed=seed):
            found.append(judged)
            tell()
    return Judged(choices, found)
