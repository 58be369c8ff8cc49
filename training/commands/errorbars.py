"""``kkl-gym errorbars``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from observers import Artifact
from observers.names import resolve
from training.commands.teaching import Teaching


@dataclass(frozen=True)
class ErrorBars(Teaching):
    """Learn how far an observer's estimates are off: the covariance of its errors, at each sample.

    T_inv stays as it is, to the last bit; an observer that tracks has to be taught that again (kkl-gym tracking). A
    small network beside it learns from motions like those of the training, but others, and is calibrated on further
    ones. Regions of 90 % then hold 90 % of the errors. That is so at each level of measurement noise that the map is
    told, at each age, with or without process noise.

    Of an observer from recorded states nothing can be simulated. It takes the records that it was trained on, --data.
    """

    steps: int = 4000
    """Batches for the network, or each of the two where motions without input have a map of their own."""
    trajectories: int = 1000
    """Number of motions to learn from, 100 at least; to calibrate on there are twice as many."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """The file to write; by default one of the map's own name in runs/errorbars."""

    def run(self, console: Console) -> Artifact:
        """Learn and write."""
        from training.recorded.errorbars import learn_recorded_error_bars
        from training.teaching.errorbars import learn_error_bars  # torch takes seconds that help need not wait for

        if Artifact.read(resolve(self.observer)).flow is not None:
            console.print(f"{self.observer} tracks; what is written does not: then run kkl-gym tracking on it")
        out = Path("runs/errorbars") / resolve(self.observer).name if self.out is None else self.out
        return self.taught(
            out,
            console,
            from_system=learn_error_bars,
            from_records=learn_recorded_error_bars,
            trajectories=self.trajectories,
            steps=self.steps,
        )
