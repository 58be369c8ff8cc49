"""The command line, ``kkl-gym`` (or ``python -m training``)."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from kkl_gym.systems import SYSTEMS, get_system
from observers import Artifact, shipped
from observers.artifact import resolve
from training.config import CLOSED_LOOP, Config, Method, Preset, override, preset, read_changes
from training.evaluate import Domain, errors, unseen_runs

Value = TypeVar("Value")
Override = Annotated[Value | None, tyro.conf.arg(help_behavior_hint="(default: the preset's)")]


@dataclass(frozen=True)
class Train:
    """Learn an observer for a system and write it to one file.

    The run's folder, runs/NAME, receives NAME.safetensors, a report (PNG), checkpoints and TensorBoard scalars.
    """

    system: tyro.conf.Positional[str]
    """A shipped system, or a class of yours as script.py:Class or module:Class."""
    method: Method = "input-aware"
    """input-aware: fitted along noisy trajectories, driven and free. spinn: the paper's pipeline, without inputs."""
    preset: Preset = "fast"
    """fast: about ten minutes on two CPU cores; it made the shipped maps. paper: the paper's sizes."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/NAME)")] = None
    """The run's folder."""
    config: Path | None = None
    """Settings that differ from the preset's, as `kkl-gym tune` writes them; options given here come before them."""
    closed_loop: bool = False
    """Fit the inverse a second time, also on trajectories of a controller that acts on the estimate (input-aware);
    takes half as long again. Writes NAME-closed-loop."""
    monitor: bool = True
    """Find limits for the observer's monitor as well, which takes a minute or two; left out where the output is not
    linear."""
    resume: bool = False
    """Go on from the checkpoints in the run's folder, if there are any."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Physical parameters that differ from the system's defaults, as in: --parameters rho 30."""
    threads: int = 2
    """CPU threads."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where networks are trained; auto takes a GPU if there is one."""
    eigenvalues: Override[tuple[float, ...]] = None
    """Real eigenvalues of A, in 1/s."""
    pairs: Override[tuple[tuple[float, float], ...]] = None
    """Complex pairs of them, real and imaginary part of each: --pairs -0.1 0.94 -0.3 2.8."""
    dt: Override[float] = None
    """Sampling interval in seconds."""
    trajectories: Override[int] = None
    """Number of simulated trajectories."""
    duration: Override[float] = None
    """Their length in seconds."""
    samples: Override[int] = None
    """Points recorded along each trajectory."""
    width: Override[int] = None
    """Neurons in each hidden layer."""
    depth: Override[int] = None
    """Number of hidden layers."""
    batch: Override[int] = None
    """Samples in a batch."""
    learning_rate: Override[float] = None
    """At its highest."""
    forward_steps: Override[int] = None
    """Batches for the forward map (spinn)."""
    inverse_steps: Override[int] = None
    """Batches for the inverse map."""
    features: Override[int] = None
    """Solve for the forward map with so many random features instead of training it, 1500 say (spinn)."""
    reach: Override[float] = None
    """A solved forward map holds along motions that start in this multiple of X."""
    physics_weight: Override[float] = None
    """Weight nu of the PDE residual (spinn)."""
    disturbed: Override[float] = None
    """Share of trajectories with process noise (input-aware)."""
    noise_max: Override[float] = None
    """Largest measurement noise to train for (input-aware)."""
    cap: Override[float] = None
    """CPU seconds after which training ends, steps done or not."""
    seed: Override[int] = None
    """Of everything random."""

    def run(self, console: Console) -> Path:
        """Train; returns the artifact's path."""
        from training.calibration import calibrate
        from training.pipeline import train
        from training.report import write_report

        if self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device cuda: torch sees no GPU; leave --device out to train on the CPU")
        torch.set_num_threads(self.threads)
        system = get_system(self.system, self.parameters)
        name = system.name if self.method == "input-aware" else f"{system.name}-{self.method}"
        name += "-closed-loop" if self.closed_loop else ""
        folder = self.out or Path("runs") / name
        names = {entry.name for entry in fields(Config)}
        changes = {key: value for key, value in vars(self).items() if key in names - {"method", "closed_loop"}}
        read = read_changes(self.config) if self.config else {}
        changes = read | {key: value for key, value in changes.items() if value is not None}
        if changes.get("features"):
            changes.setdefault("forward_steps", 0)  # what is solved for is not trained
        config = override(preset(system, self.method, self.preset), changes)
        if self.closed_loop:
            config = replace(config, closed_loop=CLOSED_LOOP)
        device = None if self.device == "auto" else torch.device(self.device)
        result = train(system, config, folder, self.resume, device, console)
        path = folder / f"{name}.safetensors"
        result.artifact.save(path)  # before anything else may fail
        if self.monitor and result.artifact.C is not None:
            try:
                with console.status("finding the monitor's limits"):
                    calibrate(result.artifact, system, seed=config.seed).save(path)
            except ValueError as error:
                console.print(f"[yellow]no limits for a monitor:[/yellow] {error}")
        console.print(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB) in {result.artifact.training['seconds']} s")
        write_report(folder / "report.png", result, system)
        console.print(f"wrote {folder / 'report.png'}")
        return path


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
                runs = unseen_runs(
                    system,
                    artifact.filter.dt,
                    self.trajectories,
                    self.duration,
                    self.seed,
                    domain,
                    driven,
                    process_noise=self.process_noise,
                )
                for level in self.noise:
                    found = errors(
                        artifact, system, runs, level, self.seed, skip=min(5.0, self.duration / 2) if driven else None
                    )
                    table.add_row(label, f"{level:g}", spread(found.full), spread(found.late), str(found.escaped))
                    lines += [
                        f'{name},"{label}{suffix}",{level:g},{i},{full:.6g},{late:.6g}'
                        for i, (full, late) in enumerate(zip(found.full, found.late))
                    ]
        console.print(table)
        return lines


@dataclass(frozen=True)
class Maps:
    """List the maps that ship with the package."""

    def run(self, console: Console) -> None:
        """Print the list."""
        table = Table("name", "method", "inputs", "modes", "noise up to", "MB")
        for name in shipped():
            path = resolve(name)
            artifact = Artifact.read(path)
            table.add_row(
                name,
                str(artifact.training.get("method")),
                str(artifact.nu),
                str(len(artifact.filter.A)),
                f"{artifact.inverse.noise_max:g}" if "measurement_noise" in artifact.inverse.features else "not told",
                f"{path.stat().st_size / 1e6:.2f}",
            )
        console.print(table)


def system_of(artifact: Artifact, given: str | None) -> System:
    """The system that an artifact was made for, checked against it."""
    if given is None and artifact.system not in SYSTEMS:
        raise ValueError(f"{artifact.system!r} is no shipped system: name its class with --system script.py:Class")
    base = get_system(given or artifact.system)
    if base.name == artifact.system and set(artifact.parameters) == set(base.parameters):
        base = base.replace(artifact.parameters)
    artifact.check(base.name, base.parameters, artifact.filter.dt, base.ny, base.nu)
    return base


def spread(values: np.ndarray) -> str:
    """Median and interquartile range as text."""
    if not len(values):
        return "–"
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{median:.2f} ({low:.2f} – {high:.2f})"


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the ``kkl-gym`` command."""
    from training.agents.command import AgentCommand
    from training.agents.compare import Compare
    from training.benchmark.command import Benchmark
    from training.certificates.command import Certify
    from training.demo import Demo
    from training.faults import Faults
    from training.speed import Speed
    from training.tuning.command import Tune

    commands: dict[str, Callable[..., Any]] = {
        "train": Train,
        "evaluate": Evaluate,
        "benchmark": Benchmark,
        "agent": AgentCommand,
        "certify": Certify,
        "tune": Tune,
        "faults": Faults,
        "maps": Maps,
        "demo": Demo,
        "speed": Speed,
    }
    console = Console()
    command: Any = tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="kkl-gym",
        description="Learned KKL observers for Gymnasium environments.",
        args=arguments,
    )
    try:
        command.run(console)
    except ModuleNotFoundError as error:
        sys.exit(f"kkl-gym: {error}; pip install 'kkl-gym[agents]' has everything")
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"kkl-gym: {error}")
    except KeyboardInterrupt:
        hint = "; --resume goes on from the last checkpoint" if isinstance(command, Train) else ""
        goes_on = isinstance(command, Benchmark) or isinstance(getattr(command, "command", None), Compare)
        hint = "; the same command goes on" if goes_on else hint
        sys.exit(f"kkl-gym: interrupted{hint}")
