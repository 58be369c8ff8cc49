"""Recorded data as options of a command: the files, and which of their columns are what."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from kkl_gym.system import System
from observers import Artifact
from training.progress import ProgressBars
from training.records import Record, Signals, read_records

_BY_NAME = "(default: by the names of the columns)"


@dataclass(frozen=True)
class DataOptions:
    """The recorded data of a command; to be annotated with ``tyro.conf.OmitArgPrefixes``."""

    data: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]", help_behavior_hint="")] = ()
    """Records: .npz files with arrays t, y and, where recorded, u and x; .csv or .parquet files with named columns;
    rollouts in a Minari data set, minari:ID or its folder, whose signals are named as in `kkl-gym record`."""
    time: Annotated[str, tyro.conf.arg(metavar="COLUMN", help_behavior_hint="(default: t or time)")] = ""
    """Column of the time in seconds."""
    measured: Annotated[str, tyro.conf.arg(metavar="COLUMNS", help_behavior_hint=_BY_NAME)] = ""
    """Measured outputs, with commas between them; y, or y1, y2, ... if they are not named."""
    inputs: Annotated[str, tyro.conf.arg(metavar="COLUMNS", help_behavior_hint=_BY_NAME)] = ""
    """Known inputs, each held until the next sample; u, or u1, u2, ... if they are not named."""
    hidden: Annotated[str, tyro.conf.arg(metavar="COLUMNS", help_behavior_hint=_BY_NAME)] = ""
    """Recorded states; x, or x1, x2, ... if they are not named. Of an angle, cos(COLUMN) and sin(COLUMN)."""

    @property
    def signals(self) -> Signals:
        """The columns that are named; ValueError if one is twice."""
        measured, inputs, hidden = (
            tuple(name.strip() for name in names.split(",") if name.strip())
            for names in (self.measured, self.inputs, self.hidden)
        )
        return Signals(self.time, measured, inputs, hidden)

    def read(self, progress: ProgressBars, system: System | None = None) -> list[Record]:
        """Read the files."""
        return self._read(self.signals, progress, system)

    def read_for(self, artifact: Artifact, progress: ProgressBars) -> list[Record]:
        """Read the files for an observer from recorded states: columns that are not named are its own."""
        signals = artifact.signals or {}
        if not self.data:
            raise ValueError(
                f"the observer {artifact.system!r} was learned from recorded states, and nothing can be simulated: "
                "name these records (--data)"
            )
        given = self.signals
        own: dict[str, Any] = {
            role: getattr(given, role) or tuple(signals[role]) for role in ("measured", "inputs", "hidden")
        }
        return self._read(replace(given, **own), progress)

    def _read(self, signals: Signals, progress: ProgressBars, system: System | None = None) -> list[Record]:
        with progress.phase("reading the records"):
            return read_records(
                self.data, signals=signals, system=system, warn=lambda text: progress.say(f"warning: {text}")
            )
