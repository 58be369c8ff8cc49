"""``kkl-gym train``."""

import re
import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from kkl_gym.system import System
from kkl_gym.systems import SYSTEMS, get_system
from training.commands.maps import tracks_by
from training.commands.options import (
    SYSTEM,
    DataOptions,
    HalfWidths,
    Parameters,
    RunOptions,
    SettingsOptions,
    hint,
    merged,
    set_threads,
)
from training.config import Pipeline
from training.presets import Preset, Size, preset
from training.progress import LOG, ProgressBars, progress_bars
from training.sources.recorded import recorded_preset
from training.spectrum import Spectrum
from training.trajectories.parameters import nominal_share, relative_ranges

if TYPE_CHECKING:
    from training.lessons import Result
    from training.sources.recorded import RecordedSource
    from training.sources.simulated import SimulatedSource

RECORDED = "recorded"  # default name of an observer from records
NAME = r"[\w][\w.-]*"  # pattern of observers' names, which are also files' names
OF_SYSTEMS = ("pipeline", "preset", "size", "uncertain", "policy", "parameters")  # options that need equations
SIMULATED = (  # settings of simulated motions
    *("trajectories", "duration", "process_noise_share", "free_inverse", "lead_in_input", "runs"),
    *("estimate_parameters", "false_alarms", "bias"),
)
MOTIONS = {"equations": "the system's equations", "flow": "a learned flow"}
OF_RECORDS = ("windows", "arbitrary_zero", "held_out")


@dataclass(frozen=True)
class Train:
    """Learn an observer from equations or from records, and write it to one file.

    kkl-gym train lorenz: a shipped system. kkl-gym train script.py: the system that the script defines. kkl-gym train
    NAME --data run*.csv: from recorded states. The folder runs/NAME receives NAME.safetensors (T_inv, the model for
    tracking, covariances, a monitor's limits), report.png, checkpoints, and log.txt with all printed lines.
    """

    system: Annotated[
        tyro.conf.Positional[str],
        hint(metavar="SYSTEM", help=f"{SYSTEM} With --data, a name of your choice for the recorded plant."),
    ] = ""
    pipeline: Pipeline = "input-aware"
    """input-aware: T_inv is fitted along noisy trajectories, with and without inputs. spinn: the paper's pipeline,
    without inputs and tracking; writes NAME-spinn."""
    preset: Preset = "fast"
    """fast: about half a minute (spinn: five minutes); it made the shipped maps. paper: the paper's sizes."""
    size: Size = "default"
    """large: a T_inv that is accurate without tracking, for use without a model; takes about ten minutes, needs
    input-aware and writes NAME-large."""
    parameters: Parameters = ()
    uncertain: HalfWidths = ()
    """Relative uncertainty of parameters: mu=0.1, or 0.1 for all. Some trajectories then have other parameters, and the
    observer serves every plant within the ranges. It does not track. Needs input-aware."""
    policy: Annotated[str | None, hint("random inputs", metavar="FUNCTION")] = None
    """Policy of the simulated motions: "controller" for the system's own, or script.py:function, from states
    (n, nx) to actions (n, nu) in [-1, 1]. For plants that leave their bounds under random inputs."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device for the training of networks; auto takes a GPU if there is one."""
    data: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Recorded motions, if the equations are unknown."""
    settings: tyro.conf.OmitArgPrefixes[SettingsOptions] = field(default_factory=SettingsOptions)
    """Changes of the preset. docs/reference/commands.md lists the settings and their defaults."""
    folder: tyro.conf.OmitArgPrefixes[RunOptions] = field(default_factory=RunOptions)

    def run(self, console: Console) -> Path:
        """Train the observer, and write its file and the report."""
        began = time.monotonic()
        set_threads(self.folder.threads)
        import torch

        from training.evaluation.report import write_report
        from training.lessons import train

        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device cuda: torch sees no GPU; leave --device out to train on the CPU")
        changes = self.settings.read()
        if self.uncertain:
            changes["uncertain"] = merged("--uncertain", self.uncertain)
        if self.policy is not None:
            changes["policy"] = self.policy
        system = None
        if not self._has_records(changes):
            system = get_system(self.system, merged("--parameters", self.parameters))
        name = self._name(system, changes)
        folder = self.folder.out or Path("runs") / name
        path = folder / f"{name}.safetensors"
        with progress_bars(console, folder / LOG) as progress:
            source = (
                self._records(name, changes, progress) if system is None else self._motions(system, changes, progress)
            )
            device = None if self.device == "auto" else torch.device(self.device)
            result = train(source, folder=folder, resume=self.folder.resume, device=device, console=progress)
            # The observer is saved before the report, which may fail.
            result.artifact.save(path)
            with progress.phase("drawing the report"):
                write_report(folder / "report.png", result, source)
            for line in summary(result):
                progress.say(line)
            size, took = path.stat().st_size / 1e6, timedelta(seconds=round(time.monotonic() - began))
            progress.say(f"wrote {path} ({size:.2f} MB), report.png and {LOG} beside it, in {took}")
            if system is not None:
                words = ["kkl-gym", "evaluate", str(path)]
                words += [] if type(system) in SYSTEMS.values() else ["--system", self.system]
                words += ["--policy", self.policy] if self.policy not in (None, "controller") else []
                progress.say(f"{shlex.join(words)} measures the observer's errors")
        return path

    def _has_records(self, changes: Mapping[str, Any]) -> bool:
        """Return whether motions are recorded, not simulated; raise ValueError for options of the other kind."""
        if not self.data.data:
            given = [f"--{option}" for option in ("time", "measured", "inputs", "hidden") if getattr(self.data, option)]
            if given := [*given, *(name for name in changes if name in OF_RECORDS)]:
                raise ValueError(f"{given[0]} needs recorded data (--data)")
            if not self.system:
                raise ValueError("name a system, or recorded data (--data)")
            return False
        plain = Train()
        given = [f"--{option}" for option in OF_SYSTEMS if getattr(self, option) != getattr(plain, option)]
        if given := given or [name for name in changes if name in SIMULATED]:
            raise ValueError(f"{', '.join(given)}: of no use with --data, where nothing is simulated")
        return True

    def _name(self, system: System | None, changes: Mapping[str, Any]) -> str:
        """Return the name of the observer and of its file."""
        if system is None:
            name = self.system or RECORDED
            if not re.fullmatch(NAME, name):
                raise ValueError(
                    f"with --data, SYSTEM is a name of your choice with letters, digits, _, - and .; got {name!r}"
                )
            return name
        if self.size != "default" and self.pipeline == "spinn":
            raise ValueError(f"--size {self.size} needs the pipeline 'input-aware', not 'spinn'")
        name = system.name if self.pipeline == "input-aware" else f"{system.name}-{self.pipeline}"
        return name if self.size == "default" else f"{name}-{self.size}"

    def _records(self, name: str, changes: Mapping[str, Any], progress: ProgressBars) -> "RecordedSource":
        from training.sources.recorded import RecordedSource

        records = self.data.read(progress)
        source = RecordedSource(records, recorded_preset(records, changes), name)
        progress.say(source.described())
        return source

    def _motions(self, system: System, changes: Mapping[str, Any], progress: ProgressBars) -> "SimulatedSource":
        from training.sources.simulated import SimulatedSource

        with progress.phase("choosing a spectrum"):
            config = preset(system, self.pipeline, self.preset, size=self.size, changes=changes)
        own = "".join(f", {parameter} = {value:g}" for parameter, value in system.parameters.items())
        counts = {"state": system.nx, "output": system.ny, "input": system.nu}
        sizes = ", ".join(f"{count} {what}{'' if count == 1 else 's'}" for what, count in counts.items())
        progress.say(f"training an observer for {system.name}{own}: {sizes}")
        given = "".join(f"; {setting} = {value}" for setting, value in changes.items())
        progress.say(f"pipeline {config.pipeline}, preset {self.preset}, size {self.size}{given}")
        spectrum = Spectrum(config.eigenvalues, config.pairs)
        rates = spectrum.poles.real
        progress.say(
            f"{config.trajectories:,} trajectories of {config.duration:g} s at dt = {config.dt:g} s; "
            f"{len(rates)} modes of A for each output, from {rates.max():.3g} to {rates.min():.3g} 1/s"
        )
        if ranges := relative_ranges(system, config.uncertain):
            others = 100 * (1 - nominal_share(ranges))
            uncertain = ", ".join(f"{parameter} from {low:g} to {high:g}" for parameter, (low, high) in ranges.items())
            estimated = ", which the map estimates" if config.estimate_parameters else ""
            progress.say(f"{others:.0f} % of the trajectories have parameters of their own: {uncertain}{estimated}")
        return SimulatedSource(system, config)


def summary(result: "Result") -> list[str]:
    """Return lines on a training: CPU time, the observer's method of estimation, and any errors on held-out records."""
    artifact = result.artifact
    by, covariance = tracks_by(artifact), artifact.inverse.error_covariance
    lines = [
        "CPU seconds: " + ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.seconds.items()),
        f"the observer tracks by {MOTIONS[by]}; T_inv initialises it" if by else "the observer is T_inv alone",
    ]
    if covariance is None:
        lines[-1] += ", without covariances"
    if (errors := artifact.training.get("held_out_errors")) is not None:
        each, after = (f"{name} {error:.3g}" for name, error in errors.items()), artifact.training["held_out_after"]
        known = ", ".join(each) or "unknown, as they hold too few samples"
        lines.append(f"rms error / standard deviation on held-out records: {known} (after {after:.2g} s of transient)")
    return lines
