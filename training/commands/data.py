"""Recorded data as options of a command: the files, and which of their columns are what."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from kkl_gym.system import System
from training.progress import ProgressBars
from training.records import Record, Signals, read_records

_BY_NAME = "(default: by the names of the columns)"


@dataclass(frozen=True)
class DataOptions:
    """The recorded data of a command; to be annotated with ``tyro.conf.OmitArgPrefixes``."""

    data: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]", help_behavior_hint="")] = ()
    """Records: .npz or .mat files with arrays t, y and, where recorded, u and x; .csv or .parquet files with named
    columns; rollouts in a Minari data set, minari:ID or its folder, whose signals are named as in `kkl-gym record`."""
    time: Annotated[str, tyro.conf.arg(metavar="COLUMN", help_behavior_hint="(default: t or time)")] = ""
    """Column of the time in seconds."""
    measured: Annotated[str, tyro.conf.arg(metavar="COLUMNS", help_behavior_hint=_BY_NAME)] = ""
    """Measured outputs, with commas between them; y, or y1, y2, ... if they are not named."""
    inputs: Annotated[str, tyro.conf.arg(metavar="COLUMNS", help_behavior_hint=_BY_NAME)] = ""
    """Known inputs, each held until the next sample; u, or u1, u2, ... if they are not named."""
    hidden: Annotated[str, tyro.conf.arg(metavar="COLUMNS", help_behavior_hint=_BY_NAME)] = ""
    """Recorded states; x, or x1, x2, ... if they are not named. Of an angle, cos(COLUMN) and sin(COLUMN)."""

    def read(self, progress: ProgressBars, system: System | None = None) -> list[Record]:
        """Read the files; ValueError if a column is named twice."""
        measured, inputs, hidden = map(names_in, (self.measured, self.inputs, self.hidden))
        signals = Signals(self.time, measured, inputs, hidden)
        with progress.phase("reading the records"):
            return read_records(
                self.data, signals=signals, system=system, warn=lambda text: progress.say(f"warning: {text}")
            )


def names_in(text: str) -> tuple[str, ...]:
    """The names between commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
