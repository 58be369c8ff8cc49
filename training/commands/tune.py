"""``kkl-gym tune``: a spectrum for a system and a noise level, and what others would have given."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from kkl_gym.system import System
from kkl_gym.systems import get_system
from observers.storage import write
from training.presets import preset
from training.spectrum import Spectrum, papers_spectrum
from training.tuning.check import rank_correlation, settings, trained_error
from training.tuning.probe import Choice, Probe

EXTENDED = "default's real ones and more"
CUTOFFS = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # of Bessel filters, in multiples of the frequency of most of y's power


@dataclass(frozen=True)
class Tune:
    """Choose the modes of A for a system and a noise level, by the error that is predicted without training.

    Takes a minute. Writes config.json for `kkl-gym train SYSTEM --config`: the real modes of the system's default and
    what adds most to them. front.csv and front.png show the predicted error against the number of modes chosen anew,
    for this noise and others. docs/tuning.md says what the prediction rests on.
    """

    system: tyro.conf.Positional[str]
    """A shipped system, or a class of yours as script.py:Class or module:Class."""
    measurement_noise: float = 0.5
    """Standard deviation of the noise on each sample of y."""
    modes: int = 21
    """Most modes for each output. They cost time in every step, and training. Below the number of the default's real
    ones, all are chosen anew."""
    dt: float = 0.01
    """Sampling interval in seconds."""
    duration: float = 50.0
    """Of a run, in seconds: how much transients count."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Physical parameters that differ from the system's defaults, as in: --parameters rho 30."""
    seed: int = 0
    """Of the motions' starts."""
    check: float | None = None
    """Also train an observer for some of the spectra, for this many CPU seconds each, and compare what they leave with
    what was predicted: check.csv."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: tuning/SYSTEM-NOISE)")] = None
    """Folder for what is written."""

    def run(self, console: Console) -> Choice:
        """Tune."""
        if not 0 <= self.measurement_noise < np.inf or self.modes < 1:
            raise ValueError(
                f"measurement_noise = {self.measurement_noise} must not be negative, modes = {self.modes} be positive"
            )
        if self.check is not None and not 0 < self.check < np.inf:
            raise ValueError(f"check = {self.check} must be a positive number of seconds")
        system = get_system(self.system, self.parameters)
        given = "".join(f" {name} {value:g}" for name, value in self.parameters.items())
        folder = self.out or Path("tuning") / f"{system.name}-{self.measurement_noise:g}{given.replace(' ', '-')}"
        start = Spectrum(preset(system, "input-aware", "fast").eigenvalues)
        with console.status(f"following motions of {system.name}"):
            probe = Probe(system, self.dt, self.duration, seed=self.seed, start=start)
        noise = self.measurement_noise
        levels = sorted({0.0, noise, noise / 5 if noise else 0.1, 2 * noise if noise else 0.5})
        fronts = {}
        for level in levels:
            with console.status(f"choosing modes for noise {level:g}"):
                fronts[level] = probe.choose(level, self.modes, anew=True)
        with console.status("comparing others"):
            others = _others(probe, system, noise, self.modes)
        if start.modes <= self.modes:
            best = replace(probe.choose(noise, self.modes)[-1], kind=EXTENDED)
            others.insert(0, best)
        else:
            small = [choice for choice in [fronts[noise][-1], *others] if choice.spectrum.modes <= self.modes]
            best = min(small, key=lambda choice: choice.error)

        table = Table("modes", "predicted error in %", "", title=f"{system.name}, measurement noise {noise:g}")
        for choice in [*fronts[noise], *others]:
            mark = "[green]written[/green]" if choice is best else ""
            table.add_row(str(choice.spectrum.modes), f"{choice.error:.3g}", f"{choice.kind} {mark}")
        if noise:
            table.add_row("–", f"{probe.least(noise):.3g}", "who knows the equations and all of y")
        console.print(table)
        config = {**settings(best.spectrum, noise), "dt": self.dt}
        write(folder / "config.json", json.dumps(config, indent=2) + "\n")
        lines = [
            f"{level:g},{choice.kind},{choice.spectrum.modes},{choice.error:.6g}"
            for level, choices in [*fronts.items(), (noise, others)]
            for choice in choices
        ]
        write(folder / "front.csv", "\n".join(["noise,kind,modes,error", *lines]) + "\n")
        _draw(folder / "front.png", system, noise, fronts, others, best)
        again = f"kkl-gym train {self.system} --config {folder / 'config.json'}"
        again += f" --parameters{given}" if given else ""
        console.print(f"wrote config.json, front.csv and front.png in {folder}; to train an observer with it:\n{again}")
        if self.check is not None:
            chosen = fronts[noise]
            some = [chosen[(len(chosen) - 1) // 2], *([chosen[-1]] if len(chosen) > 1 else []), *others]
            self._check(console, system, some, folder)
        return best

    def _check(self, console: Console, system: System, choices: list[Choice], folder: Path) -> None:
        assert self.check is not None
        torch.set_num_threads(1)
        measured = [
            trained_error(
                system,
                choice.spectrum,
                measurement_noise=self.measurement_noise,
                seconds=self.check,
                dt=self.dt,
                duration=self.duration,
            )
            for choice in track(choices, f"training observers of {system.name}", console=console)
        ]
        predicted = [choice.error for choice in choices]
        table = Table("modes", "predicted error in %", "trained: median SMAPE in %", "", title=system.name)
        for choice, found in zip(choices, measured, strict=True):
            table.add_row(str(choice.spectrum.modes), f"{choice.error:.3g}", f"{found:.3g}", choice.kind)
        correlation = rank_correlation(predicted, measured)
        console.print(table, f"rank correlation {correlation:.2f}, of {len(choices)} spectra")
        lines = [
            f"{choice.kind},{choice.spectrum.modes},{choice.error:.6g},{found:.6g}"
            for choice, found in zip(choices, measured, strict=True)
        ]
        write(folder / "check.csv", "\n".join(["kind,modes,predicted,trained", *lines]) + "\n")


def _others(probe: Probe, system: System, noise: float, most: int) -> list[Choice]:
    """The package's default and the paper's, whatever their size, and Bessel filters of at most so many modes."""
    default = preset(system, "input-aware", "fast")
    named = {"default": Spectrum(default.eigenvalues, default.pairs), "paper's": Spectrum(papers_spectrum(system))}
    found = [Choice(one, probe.error(one, noise), kind) for kind, one in named.items()]
    orders = [order for order in (system.nx + 1, 2 * system.nx + 1, 4 * system.nx + 1) if order <= most]
    if not len(probe.frequencies):  # y does not move
        return found
    return found + probe.bessel(noise, orders, CUTOFFS * np.median(probe.frequencies))


def _draw(
    path: Path, system: System, noise: float, fronts: dict[float, list[Choice]], others: list[Choice], best: Choice
) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for i, (level, choices) in enumerate(fronts.items()):
        points = np.array([[choice.spectrum.modes, choice.error] for choice in choices])
        left.semilogy(*points.T, "o-", color=f"C{i}", ms=3, lw=2 if level == noise else 1, label=f"noise {level:g}")
    color = f"C{list(fronts).index(noise)}"
    for kind, marker in ((EXTENDED, "*"), ("default", "s"), ("paper's", "^"), ("Bessel", "x")):
        points = np.array([[choice.spectrum.modes, choice.error] for choice in others if choice.kind == kind])
        if len(points):
            left.semilogy(*points.T, marker, color=color, ms=7, mfc="none", label=f"{kind}, noise {noise:g}")
    left.set(xlabel="modes for each output", ylabel="predicted error in %", title=system.name.replace("_", " "))
    left.set_ylim(top=10 * left.get_ylim()[1])  # room for the legend
    left.legend(fontsize="small", ncols=2)
    for choice in others:
        if choice.kind == "default":
            poles = choice.spectrum.poles
            right.plot(poles.real, poles.imag, "s", mfc="none", label="default")
    poles = best.spectrum.poles
    right.plot(poles.real, poles.imag, "x", color=color, label=f"written: {best.kind}")
    right.set(xscale="symlog", xlabel="Re λ in 1/s", ylabel="Im λ in rad/s", title=f"eigenvalues of A, noise {noise:g}")
    right.legend(fontsize="small")
    figure.savefig(path, dpi=110)
