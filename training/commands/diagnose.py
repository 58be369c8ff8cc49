"""``kkl-gym diagnose``."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from kkl_gym import EquationError
from kkl_gym.loading import load_class
from kkl_gym.system import System
from kkl_gym.systems import get_system
from training.commands.data import DataOptions, names_in
from training.commands.options import SYSTEM, NoiseLevels, Parameters, merged
from training.commands.record import PlayOptions
from training.files import require_writable, write
from training.progress import ProgressBars, progress_bars

if TYPE_CHECKING:
    from training.diagnosis import Finding, Observability

COLOURS = {"ok": "green", "note": "yellow", "problem": "bold red"}
# Options that are not for every subject. --measured and --hidden are for data, and make of a name an environment.
ONLY = {
    "a system": ("dt", "duration", "parameters"),
    "an environment": ("episodes", "steps", "env_kwargs"),
    "recorded data": ("time", "inputs"),
    "a system or an environment": ("policy",),
    "an environment or recorded data": ("csv",),
}


@dataclass(frozen=True)
class Diagnose:
    """Report before any training whether a system can be observed and learned, what is wrong, and what to change.

    Three kinds of subject: a system (NAME alone); an environment, which is played for it (NAME with --measured and
    --hidden); recorded data (--data, and no NAME). Takes some ten seconds.

    Of a system: its equations on all kinds of numbers, its motions, sampling, outputs and noise, and the least error of
    each state. Of data and environments: which hidden signals y and u determine, over which window and under how much
    noise. The exit status is 1 if there is a problem. docs/guides/diagnose.md explains the lines.
    """

    name: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(
            metavar="[NAME]",
            help=f"{SYSTEM} With --measured and --hidden: an environment as gym.make takes it, such as Pendulum-v1.",
            help_behavior_hint="",
        ),
    ] = None
    measurement_noise: Annotated[
        NoiseLevels,
        tyro.conf.arg(help_behavior_hint="(default: of a system, its own; else 1 % and 10 % of each output's size)"),
    ] = None
    """Standard deviations of noise on each sample of y, beside 0; one for all outputs or, as in 0.1,0.3, for each."""
    dt: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's)")] = None
    """Sampling interval of a system in seconds."""
    duration: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's)")] = None
    """Length in seconds of a system's motions that are followed."""
    policy: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: random)")] = None
    """What acts: on a system as for `kkl-gym train` ("controller", or a function of yours as script.py:function), in an
    environment as for `kkl-gym record`."""
    parameters: Parameters = ()
    seed: int = 0
    """Seed of the environment's episodes and of the comparison."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """File to which the findings are written as well."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """File for the errors by window and level of noise, of data and environments."""
    play: tyro.conf.OmitArgPrefixes[PlayOptions] = field(default_factory=PlayOptions)
    """For an environment."""
    records: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """For recorded data; --measured and --hidden are for an environment too, named as for `kkl-gym record`."""

    def run(self, console: Console) -> "list[Finding]":
        """Diagnose and print."""
        named = bool(self.records.measured or self.records.hidden)
        subject = "recorded data" if self.records.data else "an environment" if named else "a system"
        self._refuse(subject)
        for file in filter(None, (self.json, self.csv)):
            require_writable(file.parent)
        findings = []
        with progress_bars(console) as progress:
            for finding in self._of_system(progress) if subject == "a system" else self._of_signals(progress):
                findings.append(finding)
                progress.console.print(_row(finding))
        problems = sum(finding.verdict == "problem" for finding in findings)
        notes = sum(finding.verdict == "note" for finding in findings)
        console.print(f"{problems or 'no'} problem{'s' * (problems != 1)}, {notes or 'no'} note{'s' * (notes != 1)}")
        if self.json:
            write(self.json, json.dumps([asdict(finding) for finding in findings], indent=2) + "\n")
        if problems:
            raise SystemExit(1)
        return findings

    def _of_system(self, progress: ProgressBars) -> "Iterator[Finding]":
        from training.diagnosis import check  # here, because it imports torch, which help need not wait for
        from training.presets import named_policy

        system = self._system()
        policy = named_policy(system, self.policy) if self.policy else None
        progress.bar(f"checking {system.name}")
        yield from check(
            system, dt=self.dt, duration=self.duration, policy=policy, measurement_noise=self.measurement_noise
        )

    def _system(self) -> System:
        assert self.name is not None
        parameters = merged("--parameters", self.parameters)
        try:
            return get_system(self.name, parameters)
        except EquationError:  # of which the findings tell more
            return load_class(self.name, System)().replace(parameters)
        except ValueError as error:
            if not str(error).startswith("unknown system"):
                raise
            raise ValueError(f"{error}; an environment needs --measured and --hidden") from error

    def _of_signals(self, progress: ProgressBars) -> "Iterator[Finding]":
        observability = self._observability(progress)
        yield from observability.findings()
        if self.csv:
            write(self.csv, observability.csv())

    def _observability(self, progress: ProgressBars) -> "Observability":
        from training.diagnosis import observability, of_records

        if not self.records.data:
            assert self.name is not None
            return observability(
                self.name,
                measured=names_in(self.records.measured),
                hidden=names_in(self.records.hidden),
                policy=self.policy or "random",
                episodes=self.play.episodes,
                steps=self.play.steps,
                env_kwargs=dict(self.play.env_kwargs),
                measurement_noise=self.measurement_noise,
                seed=self.seed,
                console=progress,
            )
        records = self.records.read(progress)
        return of_records(records, measurement_noise=self.measurement_noise, seed=self.seed)

    def _refuse(self, subject: str) -> None:
        """Raise ValueError if the subject is not named as it must be, or an option is for another."""
        if (self.name is None) != (subject == "recorded data"):
            raise ValueError(
                f"NAME is the system or the environment, and has no place beside --data; got {self.name}"
                if self.name
                else "name a system, an environment (with --measured and --hidden), or recorded data (--data)"
            )
        values = vars(self) | vars(self.play) | vars(self.records)
        for of, options in ONLY.items():
            given = [f"--{option.replace('_', '-')}" for option in options if values[option] not in (None, "", ())]
            if given and subject not in of:
                raise ValueError(f"{', '.join(given)}: of no use for {subject}, but for {of} alone")


def _row(finding: "Finding") -> Table:
    row = Table.grid(Column(width=7), Column(width=13), Column(), padding=(0, 2, 0, 0))
    row.add_row(Text(finding.verdict, COLOURS[finding.verdict]), finding.check, Text(finding.found))
    if finding.advice:
        row.add_row("", "", Text(f"→ {finding.advice}", "bold"))
    return row
