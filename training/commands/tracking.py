"""``kkl-gym tracking``."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from observers import Artifact
from observers.names import resolve
from training.commands.teaching import Teaching
from training.presets import SMALL, Size


@dataclass(frozen=True)
class Tracking(Teaching):
    """Teach an observer to track, which lowers its errors under noise.

    T_inv and its error bars stay as they are. A small network beside them learns how the state changes over a sample,
    from simulated motions. The observer then carries its estimate on by that network and corrects it by each sample.
    T_inv says where to begin, and where to begin again if the estimate is lost. The map needs error bars, which
    kkl-gym errorbars learns.

    Of an observer from recorded states nothing can be simulated. It takes the records that it was trained on, --data,
    and what is measured has to be among the hidden signals.
    """

    size: Size = "default"
    """small: a smaller network, and a polynomial of few terms, for fast simulations and microcontrollers."""
    steps: int = 40_000
    """Batches for the network. Of a system, an eighth as many follow that learn a hundred samples in a row."""
    trajectories: int = 1600
    """Number of motions on which covariances are calibrated, 50 at least."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """The file to write; by default one of the map's own name in runs/tracking."""

    def run(self, console: Console) -> Artifact:
        """Learn and write."""
        from training.recorded.tracking import learn_recorded_tracking
        from training.teaching.tracking import learn_tracking  # torch takes seconds that help need not wait for

        out = Path("runs/tracking") / resolve(self.observer).name if self.out is None else self.out
        found = self.taught(
            out,
            console,
            from_system=learn_tracking,
            from_records=learn_recorded_tracking,
            trajectories=self.trajectories,
            steps=self.steps,
            small=self.size == SMALL,
        )
        if found.signals is None:
            words = [
                "kkl-gym",
                "evaluate",
                self.observer,
                str(out),
                *(["--system", self.system] if self.system else []),
            ]
            console.print(f"{shlex.join(words)} says what it gains", markup=False, highlight=False, soft_wrap=True)
        return found
