"""``kkl-gym maps``."""

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from observers import Artifact, shipped
from observers.artifact import resolve
from training.config import current_names


@dataclass(frozen=True)
class Maps:
    """List the maps that ship with the package."""

    def run(self, console: Console) -> None:
        """Print the list."""
        table = Table("name", "method", "inputs", "modes", "noise up to", "MB")
        for name in shipped():
            path = resolve(name)
            artifact = Artifact.read(path)
            table.add_row(
                name,
                str(current_names(artifact.training).get("pipeline")),
                str(artifact.nu),
                str(len(artifact.filter.A)),
                f"{artifact.inverse.measurement_noise_max:g}"
                if "measurement_noise" in artifact.inverse.features
                else "not told",
                f"{path.stat().st_size / 1e6:.2f}",
            )
        console.print(table)
