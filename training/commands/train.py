"""``kkl-gym train``."""

import re
import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from kkl_gym.system import System
from kkl_gym.systems import SYSTEMS, get_system
from training.commands.data import DataOptions
from training.commands.maps import tracks_by
from training.commands.options import HalfWidths, Parameters
from training.commands.settings import Settings
from training.config import Pipeline, read_changes
from training.presets import CLOSED_LOOP, Preset, Size, preset
from training.progress import LOG, ProgressBars, duration, progress_bars
from training.sources.recorded import recorded_preset
from training.spectrum import Spectrum
from training.trajectories.parameters import nominal_share, relative_ranges

if TYPE_CHECKING:
    from training.sources.recorded import RecordedSource
    from training.sources.simulated import SimulatedSource
    from training.train_observer import Result

RECORDED = "recorded"  # name of an observer from records, where the user gives none
NAME = r"[\w][\w.-]*"  # of an observer, and so of a file
OF_SYSTEMS = ("pipeline", "preset", "size", "closed_loop", "uncertain", "parameters")  # options
SIMULATED = (  # settings that say how motions are simulated
    *("trajectories", "duration", "policy", "process_noise_share", "free_inverse", "lead_in_input", "runs"),
    *("closed_loop_trajectories", "estimate_parameters", "false_alarms"),
)
MOTIONS = {"equations": "the system's equations", "flow": "a learned flow"}
OF_RECORDS = ("windows", "arbitrary_zero", "held_out")


@dataclass(frozen=True)
class Train:
    """Learn an observer and write it to one file: T_inv, the motion that it tracks by, covariances, a monitor's limits.

    Motions are simulated by a system's equations, or recorded (--data). The run's folder, runs/NAME, receives
    NAME.safetensors, report.png, checkpoints, log.txt with what is printed and, where TensorBoard is installed, its
    scalars.
    """

    system: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="SYSTEM",
            help="A shipped system, or a class of yours as script.py:Class or module:Class. With --data, a name of "
            "your choice for what was recorded.",
            help_behavior_hint="",
        ),
    ] = ""
    pipeline: Pipeline = "input-aware"
    """input-aware: fitted along noisy trajectories, driven and free. spinn: the paper's pipeline, without inputs, which
    does not track. Writes NAME-spinn."""
    preset: Preset = "fast"
    """fast: about half a minute; it made the shipped maps. paper: the paper's sizes."""
    size: Size = "default"
    """large: a T_inv that is accurate without tracking, for certificates and for use without a model; about ten minutes
    (input-aware). Writes NAME-large."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/NAME)")] = None
    """The run's folder."""
    config: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: no file)")] = None
    """JSON file of settings that differ from the preset's; options given here come before them."""
    closed_loop: bool = False
    """Fit the inverse a second time, also on 2,000 trajectories of a controller that acts on T_inv's estimate
    (input-aware). Writes NAME-closed-loop."""
    uncertain: HalfWidths = ()
    """How far a parameter may be from its value, as a part of that: mu=0.1, once for each, or 0.1 for all.
    Some motions in training then have their own (input-aware), and the observer serves every such plant. It does not
    track."""
    no_inputs: tyro.conf.FlagCreatePairsOff[bool] = False
    """Let the filter take in no inputs; an input-aware map is then fitted to free motion only."""
    resume: bool = False
    """Go on from the checkpoints in the run's folder, if there are any."""
    parameters: Parameters = field(default_factory=dict)
    threads: int = 1
    """CPU threads. More than one hardly help networks of the fast preset's size."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where networks are trained; auto takes a GPU if there is one."""
    data: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Recorded motions, where the equations are unknown."""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=dict)
    """What of the preset's configuration is to differ."""

    def run(self, console: Console) -> Path:
        """Train."""
        began = time.monotonic()
        import torch  # which takes longer to import than all the rest

        from training.evaluation.report import write_report
        from training.train_observer import train

        if self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device cuda: torch sees no GPU; leave --device out to train on the CPU")
        torch.set_num_threads(self.threads)
        changes = self._changes()
        system = None if self._has_records(changes) else get_system(self.system, self.parameters)
        name = self._name(system, changes)
        folder = self.out or Path("runs") / name
        path = folder / f"{name}.safetensors"
        with progress_bars(console, folder / LOG) as progress:
            source = (
                self._records(name, changes, progress) if system is None else self._motions(system, changes, progress)
            )
            device = None if self.device == "auto" else torch.device(self.device)
            result = train(source, folder=folder, resume=self.resume, device=device, console=progress)
            result.artifact.save(path)  # before anything else may fail
            with progress.phase("drawing the report"):
                write_report(folder / "report.png", result, source)
            for line in summary(result):
                progress.say(line)
            size, took = path.stat().st_size / 1e6, duration(time.monotonic() - began)
            progress.say(f"wrote {path} ({size:.2f} MB), report.png and {LOG} beside it, in {took}")
            if system is not None:
                progress.say(f"{self._evaluation(path, system)} measures its errors")
        return path

    def _has_records(self, changes: Mapping[str, Any]) -> bool:
        """Whether motions are recorded; ValueError if options are for the other kind."""
        if not self.data.data:
            given = [option for option in ("time", "measured", "inputs", "hidden") if getattr(self.data, option)]
            if given := [*given, *(name for name in changes if name in OF_RECORDS)]:
                raise ValueError(f"{_options(given[:1])} needs recorded data (--data)")
            if not self.system:
                raise ValueError("name a system, or recorded data (--data)")
            return False
        plain = Train()
        given = [option for option in OF_SYSTEMS if getattr(self, option) != getattr(plain, option)]
        if given := given or [name for name in changes if name in SIMULATED]:
            raise ValueError(f"{_options(given)}: of no use with --data, where nothing is simulated")
        return True

    def _changes(self) -> dict[str, Any]:
        """The settings that are to differ from the preset's: those of the file, and those of options before them."""
        changes = (read_changes(self.config) if self.config else {}) | self.settings
        if self.uncertain:
            named = [name for name, _ in self.uncertain]
            if len({*named}) < len(named):
                raise ValueError(f"--uncertain names a parameter twice: {', '.join(named)}")
            changes["uncertain"] = dict(self.uncertain)
        if self.no_inputs:
            changes["inputs"] = False
        if self.closed_loop:
            changes.setdefault("closed_loop_trajectories", CLOSED_LOOP)
        return changes

    def _name(self, system: System | None, changes: Mapping[str, Any]) -> str:
        """The observer's name, and its file's."""
        if system is None:
            name = self.system or RECORDED
            if not re.fullmatch(NAME, name):
                raise ValueError(
                    f"with --data, SYSTEM is a name of your choice, of letters, digits, _, - and .; got {name!r}"
                )
            return name
        if self.size != "default" and self.pipeline == "spinn":
            raise ValueError(f"--size {self.size} is of the pipeline 'input-aware', not 'spinn'")
        name = system.name if self.pipeline == "input-aware" else f"{system.name}-{self.pipeline}"
        name += "-closed-loop" if changes.get("closed_loop_trajectories") else ""
        return name if self.size == "default" else f"{name}-{self.size}"

    def _records(self, name: str, changes: Mapping[str, Any], progress: ProgressBars) -> "RecordedSource":
        from training.sources.recorded import RecordedSource

        records = self.data.read(progress)
        source = RecordedSource(records, recorded_preset(records, changes), name, warn=progress.say)
        for line in source.described():
            progress.say(line)
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
            f"{spectrum.modes} modes of A for each output, from {rates.max():.3g} to {rates.min():.3g} 1/s"
        )
        if ranges := relative_ranges(system, config.uncertain):
            others = 100 * (1 - nominal_share(ranges))
            uncertain = ", ".join(f"{parameter} from {low:g} to {high:g}" for parameter, (low, high) in ranges.items())
            estimated = ", which the map estimates" if config.estimate_parameters else ""
            progress.say(f"{others:.0f} % of the trajectories have parameters of their own: {uncertain}{estimated}")
        return SimulatedSource(system, config)

    def _evaluation(self, path: Path, system: System) -> str:
        """The command that evaluates the observer."""
        words = ["kkl-gym", "evaluate", str(path)]
        if type(system) not in SYSTEMS.values():
            words += ["--system", self.system]
        policy = self.settings.get("policy")
        return shlex.join([*words, *(["--policy", policy] if policy not in (None, "controller") else [])])


def summary(result: "Result") -> list[str]:
    """What a training took and made."""
    artifact = result.artifact
    by, covariance = tracks_by(artifact), artifact.inverse.error_covariance
    lines = [
        "CPU seconds: " + ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.seconds.items()),
        f"it tracks by {MOTIONS[by]}; T_inv initialises it" if by else "it does not track: its estimates are T_inv's",
    ]
    if covariance is None:
        lines[-1] += ", without covariances"
    if errors := artifact.training.get("held_out_errors"):
        each = ", ".join(f"{name} {error:.3g}" for name, error in errors.items())
        after = artifact.training["held_out_after"]
        lines.append(
            f"rms error over standard deviation on held-out records: {each} (after {after:.2g} s of transient)"
        )
    return lines


def _options(names: list[str]) -> str:
    return ", ".join(f"--{name.replace('_', '-')}" for name in names)
