"""``kkl-gym train``."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import torch
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.systems import get_system
from training.config import Config, Pipeline, read_changes, setting_types
from training.presets import CLOSED_LOOP, Preset, preset


def _options() -> type[Any]:
    """A class of all settings of a configuration, each None unless it is given, with Config's own descriptions."""
    described = Config.__pydantic_fields__  # type: ignore[attr-defined]
    options = []
    for name, kind in setting_types().items():
        if name == "pipeline":
            continue
        plain = get_args(kind)[0] if get_origin(kind) is Annotated else kind
        argument = tyro.conf.arg(
            help=" ".join((described[name].description or "").split()),
            help_behavior_hint="(default: the preset's)",
            metavar=plain.__name__.upper() if isinstance(plain, type) and get_origin(plain) is None else None,
        )
        options.append((name, Annotated[kind | None, argument], None))
    return dataclasses.make_dataclass("Settings", options, frozen=True)


if TYPE_CHECKING:
    from training.dry_run import Estimate

    Settings = Any
else:
    Settings = _options()


@dataclass(frozen=True)
class Train:
    """Learn an observer for a system and write it to one file.

    The run's folder, runs/NAME, receives NAME.safetensors, a report (PNG), checkpoints and, where TensorBoard is
    installed, its scalars.
    """

    system: tyro.conf.Positional[str]
    """A shipped system, or a class of yours as script.py:Class or module:Class."""
    pipeline: Annotated[Pipeline, tyro.conf.arg(aliases=["--method"])] = "input-aware"
    """input-aware: fitted along noisy trajectories, driven and free. spinn: the paper's pipeline, without inputs."""
    preset: Preset = "fast"
    """fast: about ten minutes; it made the shipped maps. paper: the paper's sizes."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/NAME)")] = None
    """The run's folder."""
    config: Path | None = None
    """Settings that differ from the preset's, as `kkl-gym tune` writes them; options given here come before them."""
    closed_loop: bool = False
    """Fit the inverse a second time, also on 2,000 trajectories of a controller that acts on the estimate
    (input-aware); takes half as long again. Writes NAME-closed-loop."""
    monitor: bool = True
    """Find limits for the observer's monitor as well, which takes a minute or two; left out where h takes no
    symbols."""
    resume: bool = False
    """Go on from the checkpoints in the run's folder, if there are any."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Physical parameters that differ from the system's defaults, as in: --parameters rho 30."""
    threads: int = 1
    """CPU threads. More than one hardly help networks of the fast preset's size."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where networks are trained; auto takes a GPU if there is one."""
    dry_run: bool = False
    """Train nothing; say what it would take on this machine, by a few batches of the same sizes."""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=Settings)
    """What of the preset's configuration is to differ."""

    def run(self, console: Console) -> Path | None:
        """Train; returns the artifact's path, None if the run is a dry one."""
        from training.dry_run import estimate
        from training.evaluation.calibration import calibrate
        from training.evaluation.report import write_report
        from training.pipeline import train
        from training.trajectories.expression import output_expression

        if self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device cuda: torch sees no GPU; leave --device out to train on the CPU")
        torch.set_num_threads(self.threads)
        system = get_system(self.system, self.parameters)
        given = {name: value for name, value in vars(self.settings).items() if value is not None}
        changes = (read_changes(self.config) if self.config else {}) | given
        if changes.get("random_features"):
            changes.setdefault("forward_steps", 0)  # what is solved for is not trained
        if self.closed_loop:
            changes.setdefault("closed_loop_trajectories", CLOSED_LOOP)
        config = preset(system, self.pipeline, self.preset, changes=changes)
        name = system.name if self.pipeline == "input-aware" else f"{system.name}-{self.pipeline}"
        name += "-closed-loop" if config.closed_loop_trajectories else ""
        folder = self.out or Path("runs") / name
        device = None if self.device == "auto" else torch.device(self.device)
        if self.dry_run:
            with console.status("timing a few batches"):
                console.print(expected(config, estimate(system, config, device=device)))
            return None
        result = train(system, config, folder, resume=self.resume, device=device, console=console)
        path = folder / f"{name}.safetensors"
        result.artifact.save(path)  # before anything else may fail
        try:
            if not result.artifact.knows_output:
                output_expression(system)  # an error that says why
            if self.monitor:
                with console.status("finding the monitor's limits"):
                    calibrate(result.artifact, system, seed=config.seed).save(path)
        except ValueError as error:
            console.print(f"[yellow]no limits for a monitor:[/yellow] {error}")
        console.print(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB) in {result.artifact.training['seconds']} s")
        write_report(folder / "report.png", result, system)
        console.print(f"wrote {folder / 'report.png'}")
        return path


def expected(config: Config, found: "Estimate") -> Table:
    """What a run will take, stage by stage.

    Parameters
    ----------
    config : Config
        Of the run.
    found : Estimate
        What was estimated.

    Returns
    -------
    Table
        For the console.
    """
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
        elif stage == "solving":
            size = f"{config.random_features:,} random features"
        table.add_row(stage, size, duration(seconds))
    table.add_section()
    table.add_row("all", "", duration(sum(found.seconds.values())))
    return table


def duration(seconds: float) -> str:
    """Seconds as people say them: 40 s, 12 min, 3.5 h, 2.1 days."""
    for unit, length, limit in (("s", 1, 90), ("min", 60, 5400), ("h", 3600, 48 * 3600)):
        if seconds < limit:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds / 86400:.3g} days"
