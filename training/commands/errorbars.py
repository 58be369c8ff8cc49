"""``kkl-gym errorbars``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from observers import Artifact
from observers.names import resolve
from training.commands.data import DataOptions
from training.commands.options import OwnPolicy, OwnSystem, read_observers, read_policy, refuse_simulated
from training.progress import ProgressBars, progress_bars


@dataclass(frozen=True)
class ErrorBars:
    """Learn how far an observer's estimates are off: the covariance of its errors, at each sample.

    T_inv and all else in the file stay as they are, to the last bit. A small network beside it learns from motions like
    those of the training, but others, and is calibrated on further ones. Regions of 90 % then hold 90 % of the errors.
    That is so at each level of measurement noise that the map is told, at each age, with or without process noise.

    Of an observer from recorded states nothing can be simulated. It takes the records that it was trained on, --data.
    """

    observer: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """A shipped map, or a .safetensors file."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    steps: int = 4000
    """Batches for the network, or each of the two where motions without input have a map of their own."""
    trajectories: int = 1000
    """Number of motions to learn from; to calibrate on there are twice as many."""
    seed: int = 0
    """Seed of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """The file to write; by default one of the map's own name in runs/errorbars."""
    records: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Of an observer from recorded states; columns that are not named are the observer's own."""

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
            If the observer cannot be had or has no error bars to learn, or a number makes no sense.
        """
        source = resolve(self.observer)
        out = Path("runs/errorbars") / source.name if self.out is None else self.out
        if out.suffix != ".safetensors":
            raise ValueError(f"out = {out} must end in .safetensors")
        artifact = Artifact.read(source)
        with progress_bars(console) as progress:
            found = self._from_system(progress) if artifact.signals is None else self._from_records(artifact, progress)
        found.save(out)
        console.print(f"wrote {out}")
        return found

    def _from_system(self, progress: ProgressBars) -> Artifact:
        from training.evaluation.errorbars import learn_error_bars  # torch takes seconds that help need not wait for

        ((_, artifact, system),) = read_observers([self.observer], self.system)
        self.records.refuse_for(artifact)
        return learn_error_bars(
            artifact,
            system,
            steps=self.steps,
            trajectories=self.trajectories,
            seed=self.seed,
            policy=read_policy(artifact, system, self.policy),
            console=progress,
        )

    def _from_records(self, artifact: Artifact, progress: ProgressBars) -> Artifact:
        from training.recorded.errorbars import learn_recorded_error_bars

        refuse_simulated(self, artifact)
        records = self.records.read_for(artifact, progress)
        return learn_recorded_error_bars(artifact, records, steps=self.steps, seed=self.seed, console=progress)
