"""``kkl-gym diagnose``."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from kkl_gym import EquationError
from kkl_gym.loading import load_class
from kkl_gym.system import System
from kkl_gym.systems import get_system
from training.commands.options import (
    NO_FILE,
    SYSTEM,
    DataOptions,
    NoiseLevels,
    Parameters,
    PlayOptions,
    hint,
    merged,
    names_in,
)
from training.files import require_writable, write
from training.progress import ProgressBars, progress_bars

if TYPE_CHECKING:
    from training.diagnosis import Finding

COLOURS = {"ok": "green", "note": "yellow", "problem": "bold red"}
# Options that apply only to some subjects. With --measured and --hidden, NAME is an environment.
ONLY = {
    "a system": ("dt", "duration", "parameters"),
    "an environment": ("episodes", "steps", "env_kwargs"),
    "recorded data": ("time", "inputs"),
    "a system or an environment": ("policy",),
}


@dataclass(frozen=True)
class Diagnose:
    """Report before any training whether a system can be observed and learned, with problems and their remedies.

    The subject is a system (only NAME), an environment (NAME with --measured and --hidden; the command then plays
    episodes), or recorded data (--data without NAME). The command takes about ten seconds.

    For a system it checks the equations (on floats, arrays and symbols), motions, sampling, outputs and noise, and
    reports the least error of each state that an unbiased observer can reach. For data and environments it reports
    whether y and u determine each hidden signal, over which window and under how much noise. The exit status is 1 if
    there is a problem. docs/guides/diagnose.md explains the lines.
    """

    name: Annotated[
        tyro.conf.Positional[str | None],
        hint(
            metavar="[NAME]",
            help=f"{SYSTEM} With --measured and --hidden: an environment as gym.make takes it, such as Pendulum-v1.",
        ),
    ] = None
    measurement_noise: Annotated[NoiseLevels, hint("the system's; else 1 % and 10 % of y's standard deviation")] = None
    """Noise levels to check besides 0: standard deviations of y's noise. 0.1,0.3 gives a level for each output."""
    dt: Annotated[float | None, hint("the system's")] = None
    """Sampling interval of a system in seconds."""
    duration: Annotated[float | None, hint("the system's")] = None
    """Duration of a system's simulated motions in seconds."""
    policy: Annotated[str | None, hint("random")] = None
    """Policy that chooses the inputs. For a system, as in `kkl-gym train`: "controller", or your function as
    script.py:function. For an environment, as in `kkl-gym record`."""
    parameters: Parameters = ()
    seed: int = 0
    """Seed of the episodes, the test samples and the noise on y; without effect for a system."""
    json: Annotated[Path | None, NO_FILE] = None
    """File for the findings in JSON."""
    play: tyro.conf.OmitArgPrefixes[PlayOptions] = field(default_factory=PlayOptions)
    """Options for environments."""
    records: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Options for recorded data. --measured and --hidden also serve environments, with names as in `kkl-gym record`."""

    def run(self, console: Console) -> "list[Finding]":
        """Diagnose the subject, and print the findings."""
        named = bool(self.records.measured or self.records.hidden)
        subject = "recorded data" if self.records.data else "an environment" if named else "a system"
        self._refuse(subject)
        if self.json:
            require_writable(self.json.parent)
        findings = []
        with progress_bars(console) as progress:
            for finding in self._of_system(progress) if subject == "a system" else self._of_signals(progress):
                findings.append(finding)
                progress.console.print(_row(finding))
        problems, notes = (sum(finding.verdict == kind for finding in findings) for kind in ("problem", "note"))
        console.print(f"{problems or 'no'} problem{'s' * (problems != 1)}, {notes or 'no'} note{'s' * (notes != 1)}")
        if self.json:
            write(self.json, json.dumps([asdict(finding) for finding in findings], indent=2) + "\n")
        if problems:
            raise SystemExit(1)
        return findings

    def _of_system(self, progress: ProgressBars) -> "Iterator[Finding]":
        # Imported here, so that --help does not wait for torch.
        from training.diagnosis import check
        from training.presets import named_policy

        assert self.name is not None
        parameters = merged("--parameters", self.parameters)
        try:
            system = get_system(self.name, parameters)
        except EquationError:
            # A finding will describe the error.
            system = load_class(self.name, System)().replace(parameters)
        except ValueError as error:
            if not str(error).startswith("unknown system"):
                raise
            raise ValueError(f"{error}; an environment needs --measured and --hidden") from error
        policy = named_policy(system, self.policy, self.dt) if self.policy else None
        progress.add_task(f"checking {system.name}", total=None)
        levels = self.measurement_noise
        yield from check(system, dt=self.dt, duration=self.duration, policy=policy, measurement_noise=levels)

    def _of_signals(self, progress: ProgressBars) -> "Iterator[Finding]":
        from training.diagnosis import observability, of_records

        how: dict[str, Any] = {"measurement_noise": self.measurement_noise, "seed": self.seed}
        if self.records.data:
            yield from of_records(self.records.read(progress), **how).findings()
            return
        how |= {"measured": names_in(self.records.measured), "hidden": names_in(self.records.hidden)}
        how |= {"episodes": self.play.episodes, "steps": self.play.steps, "env_kwargs": self.play.arguments}
        policy = self.policy or "random"
        yield from observability(self.name or "", policy=policy, console=progress, **how).findings()

    def _refuse(self, subject: str) -> None:
        """Raise ValueError if NAME is missing or superfluous, or an option belongs to another kind of subject."""
        if (self.name is None) != (subject == "recorded data"):
            raise ValueError(
                f"NAME is the system or the environment, and cannot be given with --data; got {self.name}"
                if self.name
                else "name a system, an environment (with --measured and --hidden), or recorded data (--data)"
            )
        values = vars(self) | vars(self.play) | vars(self.records)
        for of, options in ONLY.items():
            given = [f"--{option.replace('_', '-')}" for option in options if values[option] not in (None, "", ())]
            if given and subject not in of:
                raise ValueError(f"{', '.join(given)}: of no use for {subject}, only for {of}")


def _row(finding: "Finding") -> Table:
    row = Table.grid(Column(width=7), Column(width=13), Column(), padding=(0, 2, 0, 0))
    row.add_row(Text(finding.verdict, COLOURS[finding.verdict]), finding.check, Text(finding.found))
    if finding.advice:
        row.add_row("", "", Text(f"→ {finding.advice}", "bold"))
    return row
