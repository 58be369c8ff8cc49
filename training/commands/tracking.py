"""``kkl-gym tracking``."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from observers import Artifact
from observers.names import resolve
from training.commands.options import OwnPolicy, OwnSystem, read_observers, read_policy
from training.progress import progress_bars


@dataclass(frozen=True)
class Tracking:
    """Teach an observer to track, which lowers its errors under noise.

    T_inv and its error bars stay as they are. A small network beside them learns how the state changes over a sample,
    from simulated motions. The observer then carries its estimate on by that network and corrects it by each sample.
    T_inv says where to begin, and where to begin again if the estimate is lost. The map needs error bars, which
    kkl-gym errorbars learns.
    """

    observer: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """A shipped map, or a .safetensors file."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    steps: int = 40_000
    """Batches for the network."""
    trajectories: int = 1600
    """Number of motions on which covariances are calibrated."""
    seed: int = 0
    """Seed of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """The file to write; by default one of the map's own name in runs/tracking, with -tracking behind it."""

    def run(self, console: Console) -> Artifact:
        """Learn and write.

        Parameters
        ----------
        console : Console
            Where progress is shown.

        Returns
        -------
        Artifact
            What was written.

        Raises
        ------
        ValueError
            If the observer cannot be had, has no error bars or serves a range of plants, or a number makes no sense.
        """
        from training.evaluation.tracking import learn_tracking  # torch takes seconds that help need not wait for

        source = resolve(self.observer)
        name = re.sub(r"-v\d+$", "", source.stem)
        out = Path(f"runs/tracking/{name}-tracking.safetensors") if self.out is None else self.out
        if out.suffix != ".safetensors":
            raise ValueError(f"out = {out} must end in .safetensors")
        ((_, artifact, system),) = read_observers([self.observer], self.system)
        with progress_bars(console) as progress:
            found = learn_tracking(
                artifact,
                system,
                steps=self.steps,
                trajectories=self.trajectories,
                seed=self.seed,
                policy=read_policy(artifact, system, self.policy),
                console=progress,
            )
        found.save(out)
        console.print(f"wrote {out}")
        return found
