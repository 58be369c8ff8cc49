"""``kkl-gym maps``."""

from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from observers import Artifact, shipped
from observers.names import resolve

WIDTH = 80  # width of the table in characters; narrower terminals wrap its lines


@dataclass(frozen=True)
class Maps:
    """List the maps that ship with the package."""

    def run(self, console: Console) -> None:
        """Print a row for each map."""
        table = Table(box=SIMPLE_HEAD, show_edge=False, padding=0, width=WIDTH)
        for column in ("map", "pipeline", "tracks by"):
            table.add_column(column, no_wrap=True)
        for column in ("inputs", "modes", "noise\non y\nup to", "process\nnoise\nup to", "MB"):
            table.add_column(column, justify="right", no_wrap=True)
        for name in shipped():
            path = resolve(name)
            artifact = Artifact.read(path)
            informed = "measurement_noise" in artifact.inverse.features
            table.add_row(
                name,
                str(artifact.training.get("pipeline", "–")),
                tracks_by(artifact) or "–",
                str(artifact.nu),
                str(len(artifact.filter.A)),
                f"{artifact.inverse.measurement_noise_max:g}" if informed else "–",
                f"{artifact.process_noise_max:g}" if artifact.process_noise_max is not None else "–",
                f"{path.stat().st_size / 1e6:.2f}",
            )
        console.print(table, crop=False)


def tracks_by(artifact: Artifact) -> str:
    """Return by which model a tracker predicts: "equations", or "flow" for a learned network; "" without a tracker."""
    if artifact.motion is None:
        return ""
    return "flow" if artifact.motion.equations is None else "equations"
