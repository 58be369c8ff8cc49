"""``kkl-gym train``."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from kkl_gym.systems import get_system
from training.commands.data import DataOptions
from training.commands.options import HalfWidths, Parameters
from training.commands.settings import RecordedSettings, Settings
from training.config import Config, Pipeline, read_changes
from training.presets import CLOSED_LOOP, SMALL, SMALL_SETTINGS, Preset, Size, preset
from training.progress import LOG, ProgressBars, duration, progress_bars
from training.spectrum import Spectrum
from training.systems import named_policy
from training.trajectories.controllers import Controller
from training.trajectories.parameters import nominal_share, relative_ranges

if TYPE_CHECKING:
    import torch

    from training.dry_run import Estimate
    from training.pipeline import Result

RECORDED = "recorded"  # name of an observer from recorded states, where the user gives none


@dataclass(frozen=True)
class Train:
    """Learn an observer for a system and write it to one file.

    The run's folder, runs/NAME, receives NAME.safetensors, a report (PNG), checkpoints, log.txt with what is
    printed and, where TensorBoard is installed, its scalars.
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
    """input-aware: fitted along noisy trajectories, driven and free. spinn: the paper's pipeline, without inputs."""
    preset: Preset = "fast"
    """fast: about ten minutes; it made the shipped maps. paper: the paper's sizes."""
    size: Size = "default"
    """small: hidden layers of 20, a twentieth of the multiplications, for microcontrollers. Writes NAME-small."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/NAME)")] = None
    """The run's folder."""
    config: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: no file)")] = None
    """JSON file of settings that differ from the preset's; options given here come before them."""
    closed_loop: bool = False
    """Fit the inverse a second time, also on 2,000 trajectories of a controller that acts on the estimate
    (input-aware); takes half as long again. Writes NAME-closed-loop."""
    uncertain: HalfWidths = ()
    """How far a parameter may be from its value, as a part of that: mu=0.1, once for each, or 0.1 for all.
    Some motions in training then have their own (input-aware), and the observer serves every such plant."""
    no_inputs: tyro.conf.FlagCreatePairsOff[bool] = False
    """Let the filter take in no inputs; an input-aware map is then fitted to free motion only."""
    monitor: bool = True
    """Find limits for the observer's monitor as well, which takes a minute or more for each output; left out where h
    takes no symbols."""
    resume: bool = False
    """Go on from the checkpoints in the run's folder, if there are any."""
    parameters: Parameters = field(default_factory=dict)
    threads: int = 1
    """CPU threads. More than one hardly help networks of the fast preset's size."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where networks are trained; auto takes a GPU if there is one."""
    dry_run: bool = False
    """Train nothing; say what it would take on this machine, by short runs of the same sizes."""
    data: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Recorded states, where nobody knows the equations: T_inv is fitted to them, and nothing is simulated."""
    recorded: tyro.conf.OmitArgPrefixes[RecordedSettings] = field(default_factory=dict)
    """Of a training with --data alone."""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=dict)
    """What of the preset's configuration is to differ."""

    def run(self, console: Console) -> Path | None:
        """Train."""
        began = time.monotonic()
        import torch  # which takes longer to import than all the rest

        from training.dry_run import RUNS, estimate
        from training.evaluation.report import write_report
        from training.pipeline import train

        if self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device cuda: torch sees no GPU; leave --device out to train on the CPU")
        torch.set_num_threads(self.threads)
        device = None if self.device == "auto" else torch.device(self.device)
        if self._has_data():
            return self._train_from_data(device, console)
        system = get_system(self.system, self.parameters)
        changes = self._changes()
        with progress_bars(console) as progress, progress.phase("choosing a spectrum"):
            config = preset(system, self.pipeline, self.preset, changes=changes)
        policy = None if config.policy is None else named_policy(system, config.policy)
        if self.dry_run:
            with progress_bars(console) as progress, progress.phase("timing short runs", RUNS) as report:
                found = estimate(system, config, device=device, report=report)
            console.print(expected(config, found))
            return None
        name = system.name if self.pipeline == "input-aware" else f"{system.name}-{self.pipeline}"
        name += "-closed-loop" if config.closed_loop_trajectories else ""
        name += "" if self.size == "default" else f"-{self.size}"
        folder = self.out or Path("runs") / name
        path = folder / f"{name}.safetensors"
        with progress_bars(console, folder / LOG) as progress:
            for line in described(system, config, self.preset, changes):
                progress.say(line)
            result = train(system, config, folder, resume=self.resume, device=device, console=progress)
            result.artifact.save(path)  # before anything else may fail
            if self.monitor or not result.artifact.knows_output:  # which is to be said in any case
                find_limits(path, result, system, policy=policy, progress=progress)
            with progress.phase("drawing the report"):
                write_report(folder / "report.png", result, system, policy=policy)
            size, took = path.stat().st_size / 1e6, duration(time.monotonic() - began)
            progress.say(f"wrote {path} ({size:.2f} MB), report.png and {LOG} beside it, in {took}")
        return path

    def _has_data(self) -> bool:
        """Whether to train on recorded data; ValueError if options say both that and the contrary."""
        plain = Train()
        if not self.data.data:
            given = [option for option in ("time", "measured", "inputs", "hidden") if getattr(self.data, option)]
            given += self.recorded
            if given:
                raise ValueError(f"--{given[0].replace('_', '-')} needs recorded data (--data)")
            if not self.system:
                raise ValueError("name a system, or recorded data (--data)")
            return False
        for option in ("pipeline", "preset", "size", "closed_loop", "uncertain", "parameters", "dry_run"):
            if getattr(self, option) != getattr(plain, option):
                raise ValueError(f"--{option.replace('_', '-')} is of no use with --data, where nothing is simulated")
        return True

    def _train_from_data(self, device: "torch.device | None", console: Console) -> Path:
        from training.commands.train_recorded import train_from_data

        return train_from_data(
            self.system or RECORDED,
            self.data,
            {**self._changes(), **self.recorded},
            out=self.out,
            resume=self.resume,
            device=device,
            console=console,
        )

    def _changes(self) -> dict[str, Any]:
        """The settings that are to differ from the preset's: those of the file, and those of options before them."""
        changes = (read_changes(self.config) if self.config else {}) | self.settings
        if self.size == SMALL:
            changes = {**SMALL_SETTINGS, **changes}
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


def find_limits(
    path: Path, result: "Result", system: System, *, policy: Controller | None, progress: ProgressBars
) -> None:
    """Write an artifact again, with limits for its monitor, or say why there are none."""
    from training.teaching.monitor import PARTS, calibrate

    artifact = result.artifact
    try:
        with progress.phase("finding the monitor's limits", PARTS) as report:
            calibrate(artifact, system, seed=artifact.training["seed"], policy=policy, report=report).save(path)
    except ValueError as error:
        progress.say(f"no limits for a monitor: {error}")


def described(system: System, config: Config, name: Preset, changes: Mapping[str, Any]) -> list[str]:
    """What is going to be done."""
    own = "".join(f", {parameter} = {value:g}" for parameter, value in system.parameters.items())
    given = "".join(f"; {setting} = {value}" for setting, value in changes.items())
    counts = {"state": system.nx, "output": system.ny, "input": system.nu}
    sizes = [f"{count} {what}{'' if count == 1 else 's'}" for what, count in counts.items()]
    spectrum = Spectrum(config.eigenvalues, config.pairs)
    rates = spectrum.poles.real
    ranges = relative_ranges(system, config.uncertain)
    uncertain = ", ".join(f"{parameter} from {low:g} to {high:g}" for parameter, (low, high) in ranges.items())
    estimated = ", which the map estimates" if config.estimate_parameters else ""
    others = 100 * (1 - nominal_share(ranges))
    return [
        f"training an observer for {system.name}{own}: {', '.join(sizes)}",
        f"pipeline {config.pipeline}, preset {name}{given}",
        f"{config.trajectories:,} trajectories of {config.duration:g} s at dt = {config.dt:g} s; "
        f"{spectrum.modes} modes of A for each output, from {rates.max():.3g} to {rates.min():.3g} 1/s",
        *(
            [f"{others:.0f} % of the trajectories have parameters of their own: {uncertain}{estimated}"]
            if ranges
            else []
        ),
    ]


def expected(config: Config, found: "Estimate") -> Table:
    """What a run will take, stage by stage."""
    batches = {"forward": config.forward_steps}
    table = Table(
        "stage",
        "size",
        "time",
        title=f"{found.pairs:,} states, {found.parameters:,} weights, about {found.bytes / 1e9:.1f} GB of memory",
    )
    for stage, seconds in found.seconds.items():
        size = f"{batches.get(stage, config.inverse_steps):,} batches of {config.batch:,}"
        if stage == "simulating":
            size = f"{config.trajectories:,} trajectories of {config.duration:g} s"
        table.add_row(stage, size, duration(seconds))
    table.add_section()
    table.add_row("all", "", duration(sum(found.seconds.values())))
    return table
