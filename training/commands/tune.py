"""``kkl-gym tune``: a spectrum for a system and a noise level, and what others would have given."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from kkl_gym.systems import get_system
from observers.checks import noise_levels
from observers.storage import require_writable
from training.commands.options import NoiseLevel, Parameters, Seconds, SystemName
from training.commands.running import Workers, run_missing
from training.config import Pipeline
from training.evaluation.levels import Level, show_level
from training.presets import preset
from training.progress import progress_bars
from training.spectrum import Spectrum, papers_spectrum
from training.systems import named_policy
from training.tuning.probe import Choice, Probe

if TYPE_CHECKING:
    from training.tuning.found import Found

CUTOFFS = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # of Bessel filters, in multiples of the frequency of most of y's power


@dataclass(frozen=True)
class Tune:
    """Choose the modes of A for a system and a noise level, by the error that is predicted without training.

    Takes a minute. Writes config.json for `kkl-gym train SYSTEM --config`: the real modes of the system's default and
    what adds most to them. front.csv and front.png show the predicted error against the number of modes chosen anew,
    for this noise and others. For spinn it chooses an interval of real eigenvalues for which T is smooth, and writes
    intervals.csv instead. docs/guides/tuning.md says what the prediction rests on.
    """

    system: SystemName
    pipeline: Pipeline = "input-aware"
    """What is to be trained with the spectrum, as for `kkl-gym train`."""
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise on each sample of y, or one for each output as in 0.1,0.3."""
    modes: int = 21
    """Most modes for each output. They cost time in every step, and training. Below the number of the default's real
    ones, all are chosen anew. spinn has 2 nx + 1."""
    dt: Seconds = None
    """Sampling interval in seconds; 0.01 for the systems that ship."""
    duration: Seconds = None
    """Length of a run in seconds: how much transients count. 50 for the systems that ship."""
    policy: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: no input)")] = None
    """What acts on the motions, as for `kkl-gym train`: "controller", or a function of yours as script.py:function.
    Plants that run away without input need one."""
    parameters: Parameters = field(default_factory=dict)
    seed: int = 0
    """Seed of the motions' starts."""
    check: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: no training)")] = None
    """Also train an observer for some of the spectra, for this many CPU seconds each, and compare what they leave with
    what was predicted: check.csv."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/tuning/NAME-NOISE)")] = None
    """Folder for what is written."""
    workers: tyro.conf.OmitArgPrefixes[Workers] = field(default_factory=Workers)

    def run(self, console: Console) -> Choice:
        """Choose, print and write."""
        if self.modes < 1:
            raise ValueError(f"modes = {self.modes} must be positive")
        if self.check is not None and not 0 < self.check < np.inf:
            raise ValueError(f"check = {self.check} must be a positive number of seconds")
        if self.check is not None and self.pipeline == "spinn":
            raise ValueError("check trains input-aware maps: it must be left out with --pipeline spinn")
        if self.policy is not None and (self.check is not None or self.pipeline == "spinn"):
            raise ValueError(f"policy = {self.policy!r} must be left out with --check and with --pipeline spinn")
        system = get_system(self.system, self.parameters)
        runs = _Runs.of(self, system)
        given = "".join(f" {name} {value:g}" for name, value in self.parameters.items())
        name = system.name if self.pipeline == "input-aware" else f"{system.name}-{self.pipeline}"
        name += f"-{_of_function(self.policy)}" if self.policy else ""
        folder = (
            self.out
            or Path("runs") / "tuning" / f"{name}-{show_level(runs.noise).replace(', ', '-')}{given.replace(' ', '-')}"
        )
        again = f"kkl-gym train {self.system} --config {folder / 'config.json'}"
        again += f" --pipeline {self.pipeline}" if self.pipeline != "input-aware" else ""
        again += f" --policy {self.policy}" if self.policy else ""
        again += f" --parameters{given}" if given else ""
        require_writable(folder)
        if self.pipeline == "spinn":
            return self._intervals(system, runs, console, folder=folder, again=again)
        found = self._compare(system, runs, console)
        console.print(found.table())
        found.save(folder, {"dt": runs.dt})
        console.print(f"wrote config.json, front.csv and front.png in {folder}; to train an observer with it:\n{again}")
        if self.check is not None:
            self._check(console, found, runs, folder)
        return found.best

    def _intervals(self, system: System, runs: "_Runs", console: Console, *, folder: Path, again: str) -> Choice:
        """Judge intervals for a physics-informed map, print and write."""
        from training.tuning.intervals import judge  # pandas takes half a second to import

        with progress_bars(console) as progress, progress.phase(f"judging intervals for {system.name}", 100) as report:
            found = judge(
                system,
                runs.dt,
                duration=runs.duration,
                measurement_noise=runs.noise,
                seed=self.seed,
                report=lambda share: report(100 * share),
            )
        console.print(found.table(f"{system.name}, measurement noise {show_level(runs.noise)}"))
        found.save(folder, runs.dt)
        if not any(one.smooth for one in found.smoothness):
            console.print("[yellow]no interval makes T smooth;[/yellow] the written one comes closest")
        best, papers = found.best.spectrum.eigenvalues, papers_spectrum(system)
        if best[0] > papers[0] or best[-1] < papers[-1]:
            console.print(f"the written interval lies outside the paper's, [{papers[-1]:g}, {papers[0]:g}]")
        console.print(f"wrote config.json and intervals.csv in {folder}; to train an observer with it:\n{again}")
        return found.best

    def _compare(self, system: System, runs: "_Runs", console: Console) -> "Found":
        """Spectra chosen for some levels of noise, others for the one asked for, and the best."""
        from training.tuning.found import EXTENDED, Found

        start = Spectrum(preset(system, "input-aware", "fast").eigenvalues)
        noise = runs.noise
        levels = runs.levels(system)
        with (
            progress_bars(console) as progress,
            progress.phase(f"choosing modes for {system.name}", 3 + len(levels)) as report,
        ):
            policy = named_policy(system, self.policy) if self.policy else None
            probe = Probe(system, runs.dt, runs.duration, seed=self.seed, start=start, policy=policy)
            fronts = {}
            for done, level in enumerate(levels, 1):
                report(done)
                fronts[level] = probe.choose(level, self.modes, anew=True)
            report(1 + len(levels))
            others = self._others(probe, noise)
            report(2 + len(levels))
            if start.modes <= self.modes:
                best = replace(probe.choose(noise, self.modes)[-1], kind=EXTENDED)
                others.insert(0, best)
            else:
                small = [choice for choice in [fronts[noise][-1], *others] if choice.spectrum.modes <= self.modes]
                best = min(small, key=lambda choice: choice.error)
        return Found(system, noise, fronts, others, best, least=probe.least(noise) if np.min(noise) else None)

    def _others(self, probe: Probe, noise: Level) -> list[Choice]:
        """The package's default and the paper's, whatever their size, and Bessel filters of few enough modes."""
        system = probe.system
        default = preset(system, "input-aware", "fast")
        named = {"default": Spectrum(default.eigenvalues, default.pairs), "paper's": Spectrum(papers_spectrum(system))}
        found = [Choice(one, probe.error(one, noise), kind) for kind, one in named.items()]
        orders = [order for order in (system.nx + 1, 2 * system.nx + 1, 4 * system.nx + 1) if order <= self.modes]
        if not len(probe.frequencies):  # y does not move
            return found
        return found + probe.bessel(noise, orders, CUTOFFS * np.median(probe.frequencies))

    def _check(self, console: Console, found: "Found", runs: "_Runs", folder: Path) -> None:
        """Train observers for some of the spectra, and compare what they leave with what was predicted."""
        from training.tuning.check import Trial, rank_correlation, run_trial
        from training.tuning.found import write_csv

        assert self.check is not None
        front = found.fronts[found.noise]
        choices = [front[(len(front) - 1) // 2], *([front[-1]] if len(front) > 1 else []), *found.others]
        trials = [
            Trial(
                self.system,
                self.parameters,
                choice.spectrum,
                measurement_noise=found.noise,
                seconds=self.check,
                dt=runs.dt,
                duration=runs.duration,
                out=folder / "check",
            )
            for choice in choices
        ]
        with progress_bars(console) as progress:
            what = f"training observers of {found.system.name}"
            once = list({trial.folder: trial for trial in trials}.values())  # some spectra are found twice
            failures = run_missing(run_trial, once, workers=self.workers, what=what, progress=progress)
        if failures:
            raise ValueError(f"{len(failures)} of {len(once)} trainings failed; the first: {failures[0]}")
        measured = [trial.error for trial in trials]
        table = Table("modes", "predicted error in %", "trained: median SMAPE in %", "", title=found.system.name)
        for choice, left in zip(choices, measured, strict=True):
            table.add_row(str(choice.spectrum.modes), f"{choice.error:.3g}", f"{left:.3g}", choice.kind)
        correlation = rank_correlation([choice.error for choice in choices], measured)
        console.print(table, f"rank correlation {correlation:.2f}, of {len(choices)} spectra")
        rows = [
            (choice.kind, choice.spectrum.modes, choice.error, left)
            for choice, left in zip(choices, measured, strict=True)
        ]
        write_csv(folder / "check.csv", ["kind", "modes", "predicted", "trained"], rows)


@dataclass(frozen=True)
class _Runs:
    """What is asked for, or the system's own: noise, sampling interval and length of the runs."""

    noise: Level
    dt: float
    duration: float

    @classmethod
    def of(cls, asked: Tune, system: System) -> "_Runs":
        given = system.measurement_noise if asked.measurement_noise is None else asked.measurement_noise
        return cls(
            noise_levels("measurement_noise", given, system.ny),
            system.dt if asked.dt is None else asked.dt,
            system.duration if asked.duration is None else asked.duration,
        )

    def levels(self, system: System) -> list[Level]:
        """None, the one that is asked for, and others about it; about the system's own if none is asked for."""
        asked = bool(np.any(self.noise))
        about = self.noise if asked else system.measurement_noise
        others = np.divide(about, 5), np.multiply(2 if asked else 1, about)
        found = {0.0, self.noise, *(noise_levels("measurement_noise", level, system.ny) for level in others)}
        return sorted(found, key=lambda level: np.atleast_1d(level).tolist())


def _of_function(policy: str) -> str:
    """The name of a policy's function as a folder can have it: ``script.py:act`` is ``act``."""
    return re.sub(r"\W+", "-", policy.rpartition(":")[2])
