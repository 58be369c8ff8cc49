"""``kkl-gym maps``."""

from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from observers import Artifact, shipped
from observers.names import resolve

WIDTH = 80  # of the table; a narrower terminal breaks its lines, which cuts nothing


@dataclass(frozen=True)
class Maps:
    """List the maps that ship with the package."""

    def run(self, console: Console) -> None:
        """Print a row for each."""
        caption = "*: tracks; –: not told"
        table = Table(box=SIMPLE_HEAD, show_edge=False, padding=0, width=WIDTH, caption=caption, caption_justify="left")
        table.add_column("map", no_wrap=True)
        table.add_column("pipeline", no_wrap=True)
        for column in ("inputs", "modes", "measurement\nnoise up to", "process\nnoise\nup to", "MB"):
            table.add_column(column, justify="right", no_wrap=True)
        for name in shipped():
            path = resolve(name)
            artifact = Artifact.read(path)
            told = artifact.inverse.features
            table.add_row(
                name,
                str(artifact.training.get("pipeline", "–")) + ("" if artifact.flow is None else "*"),
                str(artifact.nu),
                str(len(artifact.filter.A)),
                f"{artifact.inverse.measurement_noise_max:g}" if "measurement_noise" in told else "–",
                f"{artifact.process_noise_max:g}" if artifact.process_noise_max is not None else "–",
                f"{path.stat().st_size / 1e6:.2f}",
            )
        console.print(table, crop=False)
