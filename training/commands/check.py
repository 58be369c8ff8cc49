"""``kkl-gym check``."""

import json
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
from observers.storage import write
from training.commands.options import Parameters, SystemName
from training.progress import progress_bars

if TYPE_CHECKING:
    from training.checking import Finding

COLOURS = {"ok": "green", "note": "yellow", "problem": "bold red"}


@dataclass(frozen=True)
class Check:
    """Look at a system before anything is trained: what is right, what is wrong, and what to change.

    Takes some ten seconds, and twice that under a policy. Equations on all kinds of numbers, starts, bounds, rate,
    sampling, outputs, target, noise, and the error to expect of each state. The exit status is 1 if there is a problem.
    docs/guides/check.md explains the lines.
    """

    system: SystemName
    dt: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's)")] = None
    """Sampling interval in seconds."""
    duration: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's)")] = None
    """Length in seconds of the motions that are followed."""
    policy: Annotated[str | None, tyro.conf.arg(help_behavior_hint="(default: random inputs)")] = None
    """What acts on the system, as for `kkl-gym train`: "controller", or a function of yours as script.py:function."""
    spinn: bool = False
    """Also look for a spectrum that makes T smooth, for --pipeline spinn: some seconds more."""
    parameters: Parameters = field(default_factory=dict)
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """File to which the findings are written as well."""

    def run(self, console: Console) -> "list[Finding]":
        """Check and print."""
        from training.checking import check  # here, because it imports torch, which help need not wait for
        from training.systems import named_policy

        try:
            system = get_system(self.system, self.parameters)
        except EquationError:  # once the system was made; what is wrong with its equations is said below
            system = load_class(self.system, System)().replace(self.parameters)
        found = []
        policy = named_policy(system, self.policy) if self.policy else None
        with progress_bars(console) as progress:
            progress.bar(f"checking {system.name}")
            for finding in check(system, dt=self.dt, duration=self.duration, policy=policy, spinn=self.spinn):
                found.append(finding)
                progress.console.print(_row(finding))
        problems = sum(finding.verdict == "problem" for finding in found)
        notes = sum(finding.verdict == "note" for finding in found)
        console.print(f"{problems or 'no'} problem{'s' * (problems != 1)}, {notes or 'no'} note{'s' * (notes != 1)}")
        if self.json:
            write(self.json, json.dumps([asdict(finding) for finding in found], indent=2) + "\n")
        if problems:
            raise SystemExit(1)
        return found


def _row(finding: "Finding") -> Table:
    row = Table.grid(Column(width=7), Column(width=13), Column(), padding=(0, 2, 0, 0))
    row.add_row(Text(finding.verdict, COLOURS[finding.verdict]), finding.check, Text(finding.found))
    if finding.advice:
        row.add_row("", "", Text(f"→ {finding.advice}", "bold"))
    return row
