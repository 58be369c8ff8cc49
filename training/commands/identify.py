"""``kkl-gym identify`` and ``kkl-gym adapt``."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from kkl_gym.systems import get_system
from observers import Artifact
from observers.names import resolve
from training.commands.data import DataOptions
from training.commands.options import OwnSystem, Parameters, SystemName, Unknowns, system_of
from training.commands.settings import Settings
from training.progress import LOG, duration, progress_bars

if TYPE_CHECKING:
    from training.identification import Learned

FARTHEST = 10.0  # factor by which a parameter without limits may move from its starting value


@dataclass(frozen=True)
class Identify:
    """Learn a plant's unknown parameters, and an observer for it, from records of its outputs alone.

    No state is needed. Multiple shooting fits the parameters and the states at which windows of the records start,
    from random starts in the training box, and gives standard errors. The observer is trained on simulated motions of
    the plant found.

    The run's folder, runs/NAME-identified, receives parameters.json, identification.png (residuals, and predictions of
    records left out), NAME.safetensors, checkpoints and log.txt. Parameters that the outputs do not identify are named,
    and are null in parameters.json.
    """

    system: SystemName
    records: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Records of the plant."""
    unknown: Unknowns = ()
    """Parameters that are not known: a first guess of each, and limits if you know them, as in mu=1.5 or mu=1.5:0.5:6.
    Without limits a parameter stays between a tenth of the guess and ten times that."""
    parameters: Parameters = field(default_factory=dict)
    """Other parameters that differ from the system's defaults."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/NAME-identified)")] = None
    """The run's folder."""
    dt: Annotated[float | None, tyro.conf.arg(metavar="SECONDS", help_behavior_hint="(default: the records')")] = None
    """Sampling interval of the observer, to which records are resampled."""
    seed: int = 0
    """Seed of everything random."""
    resume: bool = False
    """Go on from the checkpoints in the run's folder, if there are any."""
    threads: int = 1
    """CPU threads."""
    training: Settings = field(default_factory=dict)
    """What is to differ in the training of the observer."""

    def run(self, console: Console) -> Path:
        """Identify."""
        began = time.monotonic()
        import torch

        from training.identification import identify

        torch.set_num_threads(max(1, self.threads))
        unknown = merged(self.unknown)
        system = get_system(self.system, {**self.parameters, **{name: of[0] for name, of in unknown.items()}})
        folder = self.out or Path("runs") / f"{system.name}-identified"
        with progress_bars(console, folder / LOG) as progress:
            records = self.records.read(progress, system)
            learned = identify(
                system,
                limits(unknown),
                records,
                folder,
                dt=self.dt,
                settings=self.training,
                seed=self.seed,
                resume=self.resume,
                console=progress,
            )
            return finished(learned, folder, began=began, say=progress.say)


@dataclass(frozen=True)
class Adapt:
    """Learn an observer anew for a plant that differs from its model, from records of the plant's outputs.

    As kkl-gym identify, from the parameters of an observer that is there. The observer is trained again, as it was, on
    the plant found.
    """

    observer: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="OBSERVER", help="A shipped map or a .safetensors file.")
    ]
    records: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Records of the plant."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="NEW.safetensors", help_behavior_hint="")] = None
    """The new observer's file; beside it a folder of the same name receives all the rest. By default
    runs/NAME-adapted/NAME.safetensors."""
    unknown: Unknowns = ()
    """Parameters that may differ: a first guess of each, and limits if you know them, as in mu=3.2 or mu=3.2:2:4. By
    default all may, from the observer's own values on."""
    system: OwnSystem = None
    resume: bool = False
    """Go on from the checkpoints in the run's folder, if there are any."""
    threads: int = 1
    """CPU threads."""
    training: Settings = field(default_factory=dict)
    """What is to differ in the training of the observer."""

    def run(self, console: Console) -> Path:
        """Adapt."""
        began = time.monotonic()
        import torch

        from training.identification import adapt

        torch.set_num_threads(max(1, self.threads))
        artifact = Artifact.read(resolve(self.observer))
        system = system_of(artifact, self.system)
        guesses = merged(self.unknown) or {name: (value,) for name, value in system.parameters.items()}
        if not guesses:
            raise ValueError(f"{system.name} has no parameters that could be adapted")
        system = system.replace({name: numbers[0] for name, numbers in guesses.items()})
        if self.out is not None and self.out.suffix != ".safetensors":
            raise ValueError(f"out = {self.out} must be a file, NEW.safetensors")
        folder = Path("runs") / f"{system.name}-adapted" if self.out is None else self.out.with_suffix("")
        with progress_bars(console, folder / LOG) as progress:
            records = self.records.read(progress, system)
            learned = adapt(
                artifact,
                system,
                records,
                folder,
                unknown=limits(guesses),
                settings=self.training,
                resume=self.resume,
                console=progress,
            )
            path = finished(learned, folder, began=began, say=progress.say)
            if self.out is None:
                return path
            learned.result.artifact.save(self.out)
            progress.say(f"wrote {self.out}")
            return self.out


def merged(unknown: Sequence[Sequence[tuple[str, tuple[float, ...]]]]) -> dict[str, tuple[float, ...]]:
    """Unknown parameters of one option or several."""
    pairs = [pair for option in unknown for pair in option]
    names = [name for name, _ in pairs]
    if len({*names}) < len(names):
        raise ValueError(f"--unknown names a parameter twice: {', '.join(names)}")
    return dict(pairs)


def limits(unknown: Mapping[str, tuple[float, ...]]) -> dict[str, tuple[float, float]]:
    """Limits of unknown parameters: those given, or ten times as large and small as the first guess."""
    found: dict[str, tuple[float, float]] = {}
    for name, (guess, *ends) in unknown.items():
        if not ends and not guess:
            raise ValueError(f"{name} = 0 is no first guess without limits: write {name}=0:LOW:HIGH")
        low, high = ends or sorted((guess / FARTHEST, guess * FARTHEST))
        found[name] = (low, high)
    return found


def finished(learned: "Learned", folder: Path, *, began: float, say: Any) -> Path:
    """Draw the observer's report, and say what was written."""
    from training.evaluation.report import write_report

    system = learned.identified.system
    write_report(folder / "report.png", learned.result, system)
    path = folder / f"{system.name}.safetensors"
    say(
        f"wrote {path}, parameters.json, identification.png, report.png and {LOG} beside it, "
        f"in {duration(time.monotonic() - began)}"
    )
    return path
