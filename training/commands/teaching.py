"""Teaching an observer that is there already something more: what ``errorbars`` and ``tracking`` have in common."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from observers import Artifact
from observers.names import resolve
from observers.storage import require_writable
from training.commands.data import DataOptions
from training.commands.options import OwnPolicy, OwnSystem, read_observers, read_policy
from training.progress import progress_bars

SIMULATED = ("system", "policy", "trajectories")  # options of what is simulated


@dataclass(frozen=True)
class Teaching:
    """What both commands ask for."""

    observer: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """A shipped map, or a .safetensors file."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    seed: int = 0
    """Seed of everything random."""
    records: tyro.conf.OmitArgPrefixes[DataOptions] = field(default_factory=DataOptions)
    """Of an observer from recorded states; columns that are not named are the observer's own."""

    def taught(
        self,
        out: Path,
        console: Console,
        *,
        from_system: Callable[..., Artifact],
        from_records: Callable[..., Artifact],
        trajectories: int,
        **settings: Any,
    ) -> Artifact:
        """Teach the observer, from simulated motions or from the records that it was learned from, and write it."""
        if out.suffix != ".safetensors":
            raise ValueError(f"out = {out} must end in .safetensors")
        if out.is_dir():
            raise ValueError(f"out = {out} is a folder")
        source = resolve(self.observer)
        artifact = Artifact.read(source)
        if out.exists() and out.samefile(source):
            raise ValueError(f"out = {out} is the map that is taught, which would be lost: name another file")
        require_writable(out.parent)
        with progress_bars(console) as progress:
            settings |= {"seed": self.seed, "console": progress}
            if artifact.signals is None:
                ((_, artifact, system),) = read_observers([self.observer], self.system)
                if self.records != DataOptions():
                    raise ValueError(f"{artifact.system} is simulated: leave --data and its columns out")
                policy = read_policy(artifact, system, self.policy)
                found = from_system(artifact, system, trajectories=trajectories, policy=policy, **settings)
            else:
                self._refuse_simulated(artifact)
                found = from_records(artifact, self.records.read_for(artifact, progress), **settings)
        found.save(out)
        console.print(f"wrote {out}")
        return found

    def _refuse_simulated(self, artifact: Artifact) -> None:
        for name in SIMULATED:
            if getattr(self, name) != type(self).__dataclass_fields__[name].default:
                raise ValueError(
                    f"--{name}: of no use for the observer {artifact.system!r} from recorded states, where nothing is "
                    "simulated"
                )
