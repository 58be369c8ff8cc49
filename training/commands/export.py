"""``kkl-gym export MAP``: an observer for programs without Python."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from observers.storage import replacing
from training.commands.options import NoiseLevel, hint, words


def read_format(text: str) -> str:
    """Read the kind of files, in small letters or capitals."""
    if text.lower() not in ("onnx", "c"):
        raise ValueError(f"{text!r} is no format: write onnx or c")
    return text.lower()


@dataclass(frozen=True)
class ExportCommand:
    """Export an observer for programs without Python: as an ONNX graph or as C99.

    Both take in a sample and the input before it, and return the estimate, as observers.KKLObserver does. All maps can
    be exported: those that ship, of your own systems, from records and from rollouts.

    --format onnx: NAME.onnx, which takes a batch of any size, and levels of noise as inputs. It needs the extra onnx.
    --format c: NAME.h and NAME.c, which allocate nothing and need the C library alone, and NAME_main.c, a program that
    reads samples and prints estimates. docs/guides/export.md goes from end to end.
    """

    observer: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP", help="A shipped map, or a .safetensors file.")
    ]
    format: Annotated[str, words(read_format, "{onnx,c}", 1)]
    """The kind of files."""
    precision: Literal["float", "double"] = "float"
    """Type of the network, of samples and of estimates. The filter and the covariance of maps that track are doubles in
    both: floats are too coarse for them."""
    measurement_noise: Annotated[NoiseLevel, hint("the map's own")] = None
    """For --format c: standard deviation of the noise on each sample that the estimate assumes, or one for each output
    as in 0.1,0.3."""
    process_noise: Annotated[float | None, hint("the system's")] = None
    """For --format c: level of process noise that the estimate assumes."""
    out: Path = Path("runs/export")
    """Folder for the files."""

    def run(self, console: Console) -> list[Path]:
        """Export."""
        from training.export.exported import Exported

        if self.format == "onnx" and (self.measurement_noise, self.process_noise) != (None, None):
            raise ValueError(
                "levels of noise are inputs of an ONNX graph: leave out --measurement-noise and --process-noise"
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
        console.print(f"wrote {written}", markup=False, highlight=False, soft_wrap=True)  # whole paths, to be copied
        return list(files)
