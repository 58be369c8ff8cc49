"""``kkl-gym tracking``."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from observers import Artifact
from observers.names import resolve
from training.commands.data import DataOptions
from training.commands.options import OwnPolicy, OwnSystem, read_observers, read_policy, refuse_simulated
from training.progress import ProgressBars, progress_bars


@dataclass(frozen=True)
class Tracking:
    """Teach an observer to track, which lowers its errors under noise.

    T_inv and its error bars stay as they are. A small network beside them learns how the state changes over a sample,
    from simulated motions. The observer then carries its estimate on by that network and corrects it by each sample.
    T_inv says where to begin, and where to begin again if the estimate is lost. The map needs error bars, which
    kkl-gym errorbars learns.

    Of an observer from recorded states nothing can be simulated. It takes the records that it was trained on, --data,
    and what is measured has to be among the hidden signals.
    """

    observer: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """A shipped map, or a .safetensors file."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    steps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: 40,000, or 10,000 with --data)")] = None
    """Batches for the network."""
    trajectories: int = 1600
    """Number of motions on which covariances are calibrated."""
    seed: int = 0
    """Seed of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """The file to write; by default one of the map's own name in runs/tracking, with -tracking behind it."""
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
            If the observer cannot be had, has no error bars or serves a range of plants, or a number makes no sense.
        """
        source = resolve(self.observer)
        name = re.sub(r"-v\d+$", "", source.stem)
        out = Path(f"runs/tracking/{name}-tracking.safetensors") if self.out is None else self.out
        if out.suffix != ".safetensors":
            raise ValueError(f"out = {out} must end in .safetensors")
        artifact = Artifact.read(source)
        with progress_bars(console) as progress:
            found = self._from_system(progress) if artifact.signals is None else self._from_records(artifact, progress)
        found.save(out)
        console.print(f"wrote {out}")
        return found

    @property
    def _steps(self) -> dict[str, Any]:
        return {} if self.steps is None else {"steps": self.steps}

    def _from_system(self, progress: ProgressBars) -> Artifact:
        from training.evaluation.tracking import learn_tracking  # torch takes seconds that help need not wait for

        ((_, artifact, system),) = read_observers([self.observer], self.system)
        self.records.refuse_for(artifact)
        return learn_tracking(
            artifact,
            system,
            **self._steps,
            trajectories=self.trajectories,
            seed=self.seed,
            policy=read_policy(artifact, system, self.policy),
            console=progress,
        )

    def _from_records(self, artifact: Artifact, progress: ProgressBars) -> Artifact:
        from training.recorded.tracking import learn_recorded_tracking

        refuse_simulated(self, artifact)
        records = self.records.read_for(artifact, progress)
        return learn_recorded_tracking(artifact, records, **self._steps, seed=self.seed, console=progress)
