"""``kkl-gym observability``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from kkl_gym.system import System
from kkl_gym.systems import get_system
from observers.storage import require_writable
from training.commands.data import DataOptions
from training.commands.options import NoiseLevels, Parameters
from training.commands.record import Argument, names_in
from training.progress import progress_bars

if TYPE_CHECKING:
    from training.observable import Observability

# What each option is for; --measured and --hidden are for data and environments, and make the one the other.
ONLY = {
    "an environment": ("policy", "episodes", "steps", "env_kwargs"),
    "a system": ("dt", "duration", "parameters"),
    "recorded data": ("time", "inputs"),
}


@dataclass(frozen=True)
class ObservabilityCommand:
    """Say which hidden signals y and u determine, over which window and under how much noise, before any training.

    Three kinds of subject: an environment, which is played for it (NAME with --measured and --hidden); recorded data
    (--data, and no NAME); a system with equations (NAME alone). Samples with like pasts of y and u are compared across
    episodes: as far as their hidden signals differ, no observer can tell them. Takes some ten seconds.

    A signal is "determined" (no more than 5 % of its standard deviation is left), so "up to a constant" (how it changes
    is, where it is is not), "partly" or "not determined". docs/guides/observability.md says how errors are predicted,
    and how near trained observers come.
    """

    name: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(
            metavar="[NAME]",
            help="An environment as gym.make takes it, such as Pendulum-v1. Without --measured: a system, one that "
            "ships or a class of yours as script.py:Class or module:Class.",
            help_behavior_hint="",
        ),
    ] = None
    measurement_noise: Annotated[
        NoiseLevels,
        tyro.conf.arg(help_behavior_hint="(default: 1 % and 10 % of each output's size; of a system, its own)"),
    ] = None
    """Standard deviations of noise on each sample of y, beside none; one for all outputs or, as in 0.1,0.3, of each."""
    policy: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: random)")] = None
    """Who acts in an environment, as for `kkl-gym record`. What is found holds where it has been."""
    episodes: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: no limit)")] = None
    """Episodes to play in an environment."""
    steps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: 10,000 if no episodes are given)")] = None
    """Steps to play in an environment, at most."""
    env_kwargs: Annotated[
        tuple[Argument, ...], tyro.conf.UseAppendAction, tyro.conf.arg(help_behavior_hint="(default: none)")
    ] = ()
    """An argument of the environment, once for each; values are JSON, or text."""
    dt: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's own)")] = None
    """Sampling interval of a system in seconds."""
    duration: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's own)")] = None
    """Length in seconds of a system's motions that are followed."""
    parameters: Parameters = field(default_factory=dict)
    seed: int = 0
    """Of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="(default: nothing is written)")] = None
    """Folder for observability.csv and observability.png, errors against windows."""
    records: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Recorded data; --measured and --hidden are of an environment, too, and named as for `kkl-gym record`."""

    def run(self, console: Console) -> "Observability":
        """Look, print and, if asked to, write."""
        from training.observable.report import save, table  # pandas takes half a second to import

        if self.out:
            require_writable(self.out)
        found = self._looked(console)
        data = self.records.data
        first = [str(path) if str(path).startswith("minari:") else path.name for path in data[:1]]
        title = self.name or first[0] + (f" and {len(data) - 1} more" if len(data) > 1 else "")
        console.print(table(found, title))
        for text in found.warnings:
            console.print(f"note: {text}", markup=False, highlight=False, soft_wrap=True)
        if self.out:
            save(found, self.out, title)
            console.print(f"wrote observability.csv and observability.png in {self.out}")
        return found

    def _looked(self, console: Console) -> "Observability":
        from training.observable import observability, of_records, of_system

        of_data, named = bool(self.records.data), bool(self.records.measured or self.records.hidden)
        self._refuse("recorded data" if of_data else "an environment" if named else "a system")
        with progress_bars(console) as progress:
            if named and not of_data:
                assert self.name is not None
                return observability(
                    self.name,
                    measured=names_in(self.records.measured),
                    hidden=names_in(self.records.hidden),
                    policy=self.policy or "random",
                    episodes=self.episodes,
                    steps=self.steps,
                    env_kwargs=dict(self.env_kwargs),
                    measurement_noise=self.measurement_noise,
                    seed=self.seed,
                    console=progress,
                )
            records = self.records.read(progress) if of_data else []
            with progress.phase("comparing neighbours", 100) as report:

                def tell(share: float) -> None:
                    report(100 * share)

                if of_data:
                    return of_records(records, measurement_noise=self.measurement_noise, seed=self.seed, report=tell)
                return of_system(
                    self._system(),
                    dt=self.dt,
                    duration=self.duration,
                    measurement_noise=self.measurement_noise,
                    seed=self.seed,
                    report=tell,
                )

    def _system(self) -> System:
        assert self.name is not None
        try:
            return get_system(self.name, self.parameters)
        except ValueError as error:
            raise ValueError(f"{error}; of an environment, say what is --measured and --hidden") from error

    def _refuse(self, subject: str) -> None:
        """Raise ValueError if the subject is not named as it must be, or an option is for another."""
        if (self.name is None) != (subject == "recorded data"):
            raise ValueError(
                f"NAME is the environment or the system, and has no place beside --data; got {self.name}"
                if self.name
                else "name an environment (with --measured and --hidden), a system, or recorded data (--data)"
            )
        for other, options in ONLY.items():
            of = self.records if other == "recorded data" else self
            given = [
                f"--{option.replace('_', '-')}" for option in options if getattr(of, option) not in (None, "", (), {})
            ]
            if given and other != subject:
                raise ValueError(f"{', '.join(given)}: of no use for {subject}, but for {other} alone")
