"""``kkl-gym export MAP``: an observer for programs without Python."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from observers.storage import replacing
from training.commands.options import NoiseLevel, hint, words


def read_format(text: str) -> str:
    """Read the format, in lower or upper case."""
    if text.lower() not in ("onnx", "c"):
        raise ValueError(f"{text!r} is not a format: write onnx or c")
    return text.lower()


@dataclass(frozen=True)
class ExportCommand:
    """Export an observer for programs without Python: as an ONNX graph or as C99.

    Like observers.KKLObserver, the exported observer takes a sample and the input before it, and returns the estimate.
    Every map can be exported: shipped ones, those of your own systems, and those from records and rollouts.

    --format onnx: NAME.onnx takes a batch of any size, and noise levels as inputs. Exporting needs the extra onnx.
    --format c: NAME.h and NAME.c allocate no memory and need only the C library. NAME_main.c is a program that reads
    samples and prints estimates. docs/guides/export.md shows a complete example.
    """

    observer: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP", help="A shipped map, or a .safetensors file.")
    ]
    format: Annotated[str, words(read_format, "{onnx,c}", 1)]
    """The format of the files."""
    precision: Literal["float", "double"] = "float"
    """Type of the network, of samples and of estimates. The filter, and the covariance of maps that track, always need
    doubles."""
    measurement_noise: Annotated[NoiseLevel, hint("the map's own")] = None
    """For --format c: assumed standard deviation of the noise on each sample, one for all outputs or one for each as in
    0.1,0.3."""
    process_noise: Annotated[float | None, hint("the system's")] = None
    """For --format c: assumed level of process noise."""
    out: Path = Path("runs/export")
    """Folder for the files."""

    def run(self, console: Console) -> list[Path]:
        """Write the files."""
        from training.export.exported import Exported

        if self.format == "onnx" and (self.measurement_noise, self.process_noise) != (None, None):
            raise ValueError(
                "noise levels are inputs of an ONNX graph: leave out --measurement-noise and --process-noise"
            )
        exported = Exported.read(
            self.observer,
            precision=self.precision,
            measurement_noise=self.measurement_noise,
            process_noise=self.process_noise,
        )
        if self.format == "onnx":
            from training.export.onnx_graph import onnx_model

            files = {self.out / f"{exported.name}.onnx": onnx_model(exported).SerializeToString()}
        else:
            from training.export.c_source import c_files

            files = {self.out / name: text.encode() for name, text in c_files(exported).items()}
        for path, content in files.items():
            with replacing(path) as temporary:
                temporary.write_bytes(content)
        written = ", ".join(f"{path} ({len(content) / 1e3:.0f} kB)" for path, content in files.items())
        # The printed paths have no line breaks, so that they can be copied.
        console.print(f"wrote {written}", markup=False, highlight=False, soft_wrap=True)
        return list(files)
