"""``kkl-gym identify``."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from kkl_gym.systems import get_system
from observers import Artifact
from observers.names import resolve
from training.commands.options import (
    DataOptions,
    Parameters,
    RunOptions,
    SettingsOptions,
    SystemName,
    Unknowns,
    hint,
    merged,
    set_threads,
    system_of,
)
from training.progress import LOG, progress_bars

FARTHEST = 10.0  # largest factor between a parameter without limits and its first guess


@dataclass(frozen=True)
class Identify:
    """Learn a plant's unknown parameters, and an observer for it, from records of its outputs and inputs.

    No recorded state is needed. Multiple shooting fits the parameters (with standard errors) and the initial state of
    each window of the records; the search begins at random states in the training box. The observer is then trained on
    simulated motions of the identified plant. --observer adapts an observer to a plant that differs from the
    observer's model, with the settings of the observer's training.

    The folder (runs/NAME-identified, or runs/NAME-adapted with --observer) receives parameters.json, identification.png
    (residuals, and predictions of held-out records), NAME.safetensors, report.png, checkpoints and log.txt. Parameters
    that the outputs do not identify are null in parameters.json; log.txt names them.
    """

    system: SystemName
    unknown: Unknowns = ()
    """Unknown parameters: a first guess of each, and limits if you know them, as in mu=1.5 or mu=1.5:0.5:6. Without
    limits a parameter stays between a tenth of the guess and ten times the guess. With --observer the default is all
    parameters, with the observer's values as first guesses."""
    parameters: Parameters = ()
    observer: Annotated[str | None, hint("none", metavar="MAP")] = None
    """An observer of the plant's model to adapt: a shipped map or a .safetensors file."""
    data: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Records of the plant."""
    settings: tyro.conf.OmitArgPrefixes[SettingsOptions] = field(default_factory=SettingsOptions)
    """Settings of the observer's training; by default, dt is that of the records or of --observer."""
    folder: tyro.conf.OmitArgPrefixes[RunOptions] = field(default_factory=RunOptions)

    def run(self, console: Console) -> Path:
        """Identify the plant, train the observer, and write a report of each."""
        began = time.monotonic()
        set_threads(self.folder.threads)
        from training.evaluation.report import write_report
        from training.identification import adapt, identify

        unknown, parameters = merged("--unknown", self.unknown), merged("--parameters", self.parameters)
        artifact = None if self.observer is None else Artifact.read(resolve(self.observer))
        if artifact is None:
            model = get_system(self.system, parameters)
        elif parameters:
            raise ValueError("--parameters: of no use with --observer, which has its own parameters")
        else:
            model = system_of(artifact, self.system)
            unknown = unknown or {name: (value,) for name, value in model.parameters.items()}
            if not unknown:
                raise ValueError(f"{model.name} has no parameters to adapt")
        model = model.replace({name: guess for name, (guess, *_) in unknown.items()})
        folder = self.folder.out or Path("runs") / f"{model.name}-{'adapted' if artifact else 'identified'}"
        with progress_bars(console, folder / LOG) as progress:
            records, settings = self.data.read(progress, model), self.settings.read()
            how: dict[str, Any] = {"resume": self.folder.resume, "console": progress}
            if artifact is not None:
                learned = adapt(artifact, model, records, folder, unknown=limits(unknown), settings=settings, **how)
            else:
                how |= {"dt": settings.pop("dt", None), "seed": settings.get("seed", 0)}
                learned = identify(model, limits(unknown), records, folder, settings=settings, **how)
            write_report(folder / "report.png", learned.result, learned.identified.system)
            path = folder / f"{model.name}.safetensors"
            progress.say(
                f"wrote {path}, parameters.json, identification.png, report.png and {LOG} beside it, "
                f"in {timedelta(seconds=round(time.monotonic() - began))}"
            )
        return path


def limits(unknown: Mapping[str, tuple[float, ...]]) -> dict[str, tuple[float, float]]:
    """Return limits of unknown parameters: the given ones, or a tenth of the first guess and ten times the guess."""
    by_name: dict[str, tuple[float, float]] = {}
    for name, (guess, *ends) in unknown.items():
        if not ends and not guess:
            raise ValueError(f"{name} = 0 as a first guess needs limits: write {name}=0:LOW:HIGH")
        low, high = ends or sorted((guess / FARTHEST, guess * FARTHEST))
        by_name[name] = (low, high)
    return by_name
