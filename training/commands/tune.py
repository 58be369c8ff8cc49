"""``kkl-gym tune``: a spectrum for a system and a noise level, and what others would have given."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pandas as pd
import torch
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from kkl_gym.systems import get_system
from observers.storage import replacing, write
from training.config import Pipeline
from training.presets import preset
from training.progress import progress_bars
from training.spectrum import Spectrum, papers_spectrum
from training.tuning.check import rank_correlation, settings, trained_error
from training.tuning.intervals import judge
from training.tuning.probe import Choice, Probe

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXTENDED = "default's real ones and more"
CUTOFFS = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # of Bessel filters, in multiples of the frequency of most of y's power


@dataclass(frozen=True)
class Tune:
    """Choose the modes of A for a system and a noise level, by the error that is predicted without training.

    Takes a minute. Writes config.json for `kkl-gym train SYSTEM --config`: the real modes of the system's default and
    what adds most to them. front.csv and front.png show the predicted error against the number of modes chosen anew,
    for this noise and others. For spinn it chooses an interval of real eigenvalues for which T is smooth, and writes
    intervals.csv instead. docs/tuning.md says what the prediction rests on.
    """

    system: tyro.conf.Positional[str]
    """A shipped system, or a class of yours as script.py:Class or module:Class."""
    pipeline: Pipeline = "input-aware"
    """What is to be trained with the spectrum, as for `kkl-gym train`."""
    measurement_noise: float = 0.5
    """Standard deviation of the noise on each sample of y."""
    modes: int = 21
    """Most modes for each output. They cost time in every step, and training. Below the number of the default's real
    ones, all are chosen anew. spinn has 2 nx + 1."""
    dt: float = 0.01
    """Sampling interval in seconds."""
    duration: float = 50.0
    """Length of a run in seconds: how much transients count."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Physical parameters that differ from the system's defaults, as in: --parameters rho 30."""
    seed: int = 0
    """Seed of the motions' starts."""
    check: float | None = None
    """Also train an observer for some of the spectra, for this many CPU seconds each, and compare what they leave with
    what was predicted: check.csv."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/tuning/NAME-NOISE)")] = None
    """Folder for what is written."""

    def run(self, console: Console) -> Choice:
        """Choose, print and write.

        Parameters
        ----------
        console : rich.console.Console
            For people.

        Returns
        -------
        Choice
            What config.json holds.

        Raises
        ------
        ValueError
            If an option makes no sense, or the system's motions cannot be followed.
        """
        if not 0 <= self.measurement_noise < np.inf or self.modes < 1:
            raise ValueError(
                f"measurement_noise = {self.measurement_noise} must not be negative, modes = {self.modes} be positive"
            )
        if self.check is not None and not 0 < self.check < np.inf:
            raise ValueError(f"check = {self.check} must be a positive number of seconds")
        if self.check is not None and self.pipeline == "spinn":
            raise ValueError("check trains input-aware maps: it must be left out with --pipeline spinn")
        system = get_system(self.system, self.parameters)
        given = "".join(f" {name} {value:g}" for name, value in self.parameters.items())
        name = system.name if self.pipeline == "input-aware" else f"{system.name}-{self.pipeline}"
        folder = self.out or Path("runs") / "tuning" / f"{name}-{self.measurement_noise:g}{given.replace(' ', '-')}"
        again = f"kkl-gym train {self.system} --config {folder / 'config.json'}"
        again += f" --pipeline {self.pipeline}" if self.pipeline != "input-aware" else ""
        again += f" --parameters{given}" if given else ""
        if self.pipeline == "spinn":
            return self._intervals(system, console, folder=folder, again=again)
        found = self._compare(system, console)
        console.print(found.table())
        found.save(folder, {"dt": self.dt})
        console.print(f"wrote config.json, front.csv and front.png in {folder}; to train an observer with it:\n{again}")
        if self.check is not None:
            self._check(console, found, folder)
        return found.best

    def _intervals(self, system: System, console: Console, *, folder: Path, again: str) -> Choice:
        """Judge intervals for a physics-informed map, print and write."""
        with console.status(f"following motions of {system.name}"):
            found = judge(
                system, self.dt, duration=self.duration, measurement_noise=self.measurement_noise, seed=self.seed
            )
        console.print(found.table(f"{system.name}, measurement noise {self.measurement_noise:g}"))
        found.save(folder, self.dt)
        if not any(one.smooth for one in found.smoothness):
            console.print("[yellow]no interval makes T smooth;[/yellow] the written one comes closest")
        best, papers = found.best.spectrum.eigenvalues, papers_spectrum(system)
        if best[0] > papers[0] or best[-1] < papers[-1]:
            console.print(f"the written interval lies outside the paper's, [{papers[-1]:g}, {papers[0]:g}]")
        console.print(f"wrote config.json and intervals.csv in {folder}; to train an observer with it:\n{again}")
        return found.best

    def _compare(self, system: System, console: Console) -> "_Found":
        """Spectra chosen for some levels of noise, others for the one asked for, and the best."""
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
            others = self._others(probe)
        if start.modes <= self.modes:
            best = replace(probe.choose(noise, self.modes)[-1], kind=EXTENDED)
            others.insert(0, best)
        else:
            small = [choice for choice in [fronts[noise][-1], *others] if choice.spectrum.modes <= self.modes]
            best = min(small, key=lambda choice: choice.error)
        return _Found(system, noise, fronts, others, best, least=probe.least(noise) if noise else None)

    def _others(self, probe: Probe) -> list[Choice]:
        """The package's default and the paper's, whatever their size, and Bessel filters of few enough modes."""
        system, noise = probe.system, self.measurement_noise
        default = preset(system, "input-aware", "fast")
        named = {"default": Spectrum(default.eigenvalues, default.pairs), "paper's": Spectrum(papers_spectrum(system))}
        found = [Choice(one, probe.error(one, noise), kind) for kind, one in named.items()]
        orders = [order for order in (system.nx + 1, 2 * system.nx + 1, 4 * system.nx + 1) if order <= self.modes]
        if not len(probe.frequencies):  # y does not move
            return found
        return found + probe.bessel(noise, orders, CUTOFFS * np.median(probe.frequencies))

    def _check(self, console: Console, found: "_Found", folder: Path) -> None:
        """Train observers for some of the spectra, and compare what they leave with what was predicted."""
        assert self.check is not None
        torch.set_num_threads(1)
        front = found.fronts[found.noise]
        choices = [front[(len(front) - 1) // 2], *([front[-1]] if len(front) > 1 else []), *found.others]
        with progress_bars(console) as progress:
            measured = [
                trained_error(
                    found.system,
                    choice.spectrum,
                    measurement_noise=found.noise,
                    seconds=self.check,
                    dt=self.dt,
                    duration=self.duration,
                )
                for choice in progress.track(choices, description=f"training observers of {found.system.name}")
            ]
        table = Table("modes", "predicted error in %", "trained: median SMAPE in %", "", title=found.system.name)
        for choice, left in zip(choices, measured, strict=True):
            table.add_row(str(choice.spectrum.modes), f"{choice.error:.3g}", f"{left:.3g}", choice.kind)
        correlation = rank_correlation([choice.error for choice in choices], measured)
        console.print(table, f"rank correlation {correlation:.2f}, of {len(choices)} spectra")
        rows = [
            (choice.kind, choice.spectrum.modes, choice.error, left)
            for choice, left in zip(choices, measured, strict=True)
        ]
        _write_csv(folder / "check.csv", ["kind", "modes", "predicted", "trained"], rows)


@dataclass(frozen=True)
class _Found:
    """What tuning found for a system.

    Parameters
    ----------
    system : System
        That is to be observed.
    noise : float
        Standard deviation of the measurement noise to tune for.
    fronts : dict of float to list of Choice
        Spectra of more and more modes by level of noise.
    others : list of Choice
        To compare with, at ``noise``.
    best : Choice
        One of them.
    least : float or None
        Error in percent of whoever knows the equations; None without noise.
    """

    system: System
    noise: float
    fronts: dict[float, list[Choice]]
    others: list[Choice]
    best: Choice
    least: float | None

    def table(self) -> Table:
        """For people."""
        table = Table(
            "modes", "predicted error in %", "", title=f"{self.system.name}, measurement noise {self.noise:g}"
        )
        for choice in [*self.fronts[self.noise], *self.others]:
            mark = "[green]written[/green]" if choice is self.best else ""
            table.add_row(str(choice.spectrum.modes), f"{choice.error:.3g}", f"{choice.kind} {mark}")
        if self.least is not None:
            table.add_row("–", f"{self.least:.3g}", "who knows the equations and all of y")
        return table

    def save(self, folder: Path, beside: dict[str, Any]) -> None:
        """Write config.json, with some settings beside those that were found, front.csv and front.png."""
        config = {**settings(self.best.spectrum, self.noise), **beside}
        write(folder / "config.json", json.dumps(config, indent=2) + "\n")
        rows = [
            (level, choice.kind, choice.spectrum.modes, choice.error)
            for level, choices in [*self.fronts.items(), (self.noise, self.others)]
            for choice in choices
        ]
        _write_csv(folder / "front.csv", ["noise", "kind", "modes", "error"], rows)
        with replacing(folder / "front.png") as temporary:
            self.figure().savefig(temporary, dpi=110)

    def figure(self) -> "Figure":
        """Predicted errors against numbers of modes, and the eigenvalues that are written."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(11, 4), layout="constrained")
        left, right = figure.subplots(1, 2)
        color = f"C{list(self.fronts).index(self.noise)}"
        for i, (level, choices) in enumerate(self.fronts.items()):
            width = 2 if level == self.noise else 1
            left.semilogy(*_points(choices), "o-", color=f"C{i}", ms=3, lw=width, label=f"noise {level:g}")
        for kind, marker in ((EXTENDED, "*"), ("default", "s"), ("paper's", "^"), ("Bessel", "x")):
            same = [choice for choice in self.others if choice.kind == kind]
            if same:
                label = f"{kind}, noise {self.noise:g}"
                left.semilogy(*_points(same), marker, color=color, ms=7, mfc="none", label=label)
        title = self.system.name.replace("_", " ")
        left.set(xlabel="modes for each output", ylabel="predicted error in %", title=title)
        left.set_ylim(top=10 * left.get_ylim()[1])  # room for the legend
        left.legend(fontsize="small", ncols=2)
        for choice in self.others:
            if choice.kind == "default":
                poles = choice.spectrum.poles
                right.plot(poles.real, poles.imag, "s", mfc="none", label="default")
        poles = self.best.spectrum.poles
        right.plot(poles.real, poles.imag, "x", color=color, label=f"written: {self.best.kind}")
        right.set(xscale="symlog", xlabel="Re λ in 1/s", ylabel="Im λ in rad/s")
        right.set_title(f"eigenvalues of A, noise {self.noise:g}")
        right.legend(fontsize="small")
        return figure


def _points(choices: list[Choice]) -> np.ndarray:
    return np.array([[choice.spectrum.modes, choice.error] for choice in choices]).T


def _write_csv(path: Path, columns: list[str], rows: list[tuple[Any, ...]]) -> None:
    write(path, pd.DataFrame(rows, columns=columns).to_csv(index=False, float_format="%.6g"))
